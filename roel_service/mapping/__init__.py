"""Events and camera poses in, a map of 3D line segments out: the RoEL pipeline.

`pipeline.build_line_map` calls one function for each stage of the paper, in the paper's order;
each stage lives in the module of its name. Knows nothing of files, gRPC or databases.
"""
