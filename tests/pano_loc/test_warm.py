import sys

from numba.core.dispatcher import Dispatcher

from roel_service.config.stages import LocalizeConfig
from roel_service.pano_loc.hints import PosePrior
from roel_service.pano_loc.localize import localize_panorama, localize_photograph
from roel_service.pano_loc.prepare import prepare_map
from roel_service.pano_loc.warm import warm_up
from tests.pano_loc.rooms import map_of, pose, segments_of
from tests.pano_loc.test_photograph import CAMERA, FIRST
from tests.pano_loc.test_photograph import TRUTH as PHOTOGRAPH
from tests.pano_loc.wireframe import wireframe_panorama, wireframe_photograph

CONFIG = LocalizeConfig()
TRUTH = pose(1.7, 1.5, 1.4, 0.1, -0.2, 0.7)


def loaded():
    """Kinds of arguments that each loop was compiled for."""
    modules = [
        sys.modules[name] for name in sys.modules if name.startswith("roel_service.pano_loc")
    ]
    return {
        (module.__name__, name): len(value.signatures)
        for module in modules
        for name, value in vars(module).items()
        if isinstance(value, Dispatcher)
    }


def test_after_warming_up_no_query_compiles_a_loop():
    warm_up()
    before = loaded()
    room = prepare_map(map_of(noise_m=0.005), CONFIG)
    localize_panorama(wireframe_panorama(TRUTH, segments_of(), 1024), [room], CONFIG)
    picture = wireframe_photograph(PHOTOGRAPH, segments_of(), CAMERA)
    prior = PosePrior(T_world_picture=FIRST)
    localize_photograph(picture, CAMERA, [room], CONFIG, prior=prior)
    assert before["roel_service.pano_loc.refine_kernels", "refined"] > 0
    assert loaded() == before
