"""Maps and poses against the truth: the figures that every comparison reports."""
