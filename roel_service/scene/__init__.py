"""The nouns that every application package shares: events, cameras, trajectories, lines, results.

Each is a frozen dataclass whose constructor checks dtype, shape and finiteness once; code behind
it trusts its input. Constructors take ownership of the arrays they are given.
"""
