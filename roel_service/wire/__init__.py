"""The one place where domain types meet bytes: protobuf messages, event chunks, map files.

Pairs `foo_to_proto` / `foo_from_proto`; a client imports this without loading an algorithm.
"""
