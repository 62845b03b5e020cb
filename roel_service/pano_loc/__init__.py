"""Panoramic localization: where in a line map a 360-degree picture was taken.

In: a grey panorama, a `LineMap` prepared once, a `LocalizeConfig`, maybe a prior pose. Out: a
`PanoLocResult`, whose status says whether the pose may be relied on.

`arcs.py` finds straight edges as arcs of great circles; `prepare.py` makes of a map what the search
looks up; `search.py` finds rotations from shared directions and places from fields of distances;
`refine.py` makes poses exact; `verdict.py` weighs them; `localize.py` calls these five in turn.
`views_kernels.py` has what lines look like from places, in bits, and `sight_kernels.py` from a pose.
Nothing here depends on how the map lies in the world, and no right angles are assumed.
"""
