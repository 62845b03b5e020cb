"""FGPL: fully geometric panoramic localization (Kim, Jeong, Kim, CVPR 2024), as an anchor.

In: a grey panorama, line maps prepared once, `FgplParameters`. Out: one pose, without a verdict.

The modules are the paper's stages: `line_extraction.py`, `principal_directions.py` (by voting on the
sphere), `intersections.py` (of lines, told apart by their pair of directions),
`distance_functions.py` (of lines and of points, on the sphere), `pose_search.py` (24 rotations,
a pool of translations, the best of all), `pose_refinement.py` (translation, then rotation);
`localize.py` calls them, and `verdict.py` lends the pose the default's verdict.

`PUBLISHED` follows the paper, and the released code where the paper is silent; `RELEASED` has what
that code does otherwise. Numbers that are no parameter are those of the released code.
"""
