"""Registration: where a line map lies in a point cloud or in another line map.

In: a `LineMap` (or bare points) as source, a `PointCloud` (or another `LineMap`) as target, a
`RegisterConfig`. Out: a `RegistrationResult` with a verdict.

`register.py` is the way in; `source.py` samples the lines, `prepare.py` turns the target into what
the solvers look up; a result is judged in `verdict.py`, alike for every method.
"""
