"""The gRPC front: decode, call, encode. It never computes and never loads an algorithm."""
