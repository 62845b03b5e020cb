import sys

from numba.core.dispatcher import Dispatcher

from roel_service.config.stages import TrackConfig
from roel_service.scene.results import PoseStatus
from roel_service.tracking.tracker import PoseTracker
from roel_service.tracking.warm import warm_up

from .synthetic import CAMERA, recording


def loaded():
    """Kinds of arguments that each loop was compiled for, of tracking and of what finds lines."""
    names = [name for name in sys.modules if name.startswith("roel_service.")]
    return {
        (module, name): len(value.signatures)
        for module in names
        for name, value in vars(sys.modules[module]).items()
        if isinstance(value, Dispatcher)
    }


def test_after_warming_up_no_push_compiles_a_loop():
    warm_up()
    before = loaded()
    room = recording()
    tracker = PoseTracker(room.line_map, CAMERA, TrackConfig(), room.pose(25_000))
    poses = [pose for chunk in room.chunks() for pose in tracker.push(chunk)]
    assert poses[-1].status is PoseStatus.TRACKING
    assert before["roel_service.tracking.search_kernels", "scores"] > 0
    assert loaded() == before
