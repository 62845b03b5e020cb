import numpy as np

from roel_service.scene.lines import LineMap
from roel_service.tracking.pieces import pieces_of


def upright(x_m):
    return [[x_m, 0.0, 2.0], [x_m, 1.0, 2.0]]


def level(y_m):
    return [[0.0, y_m, 2.0], [3.0, y_m, 2.0]]


def test_lines_along_one_another_are_one_edge():
    # Two flanks of one edge, another edge, and level lines that cross all of them.
    lines = [upright(0.5), upright(0.505), upright(2.0), level(0.1), level(0.5), level(0.9)]
    pieces = pieces_of(LineMap.from_segments(np.array(lines)))
    is_upright = np.abs(pieces.direction[:, 1]) > 0.9
    at_half = is_upright & (np.abs(pieces.segments[:, 0, 0] - 0.5) < 0.01)
    assert len(set(pieces.edge[at_half])) == 1
    assert len(set(pieces.edge[is_upright])) == 2
    assert len(set(pieces.edge)) == 5
