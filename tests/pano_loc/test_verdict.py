import numpy as np

from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.se3 import SE3
from roel_service.pano_loc.prepare import prepare_map
from roel_service.pano_loc.search import Candidates
from roel_service.pano_loc.verdict import hypotheses
from tests.pano_loc.rooms import map_of, pose, seen_from, segments_of

TRUTH = pose(1.7, 1.6, 1.4, 0.1, 0.2, 0.8)


def sigma_m(noise_m):
    prepared = prepare_map(map_of(noise_m=noise_m), LocalizeConfig())
    poses = SE3(rotation=TRUTH.rotation[None], translation=TRUTH.translation[None])
    candidates = Candidates(poses=poses, score=np.ones(1))
    found = hypotheses(candidates, seen_from(TRUTH, segments_of()), prepared, 0)[0]
    return np.sqrt(np.trace(found.covariance[3:, 3:]))


def test_a_pose_in_a_map_that_is_off_is_less_certain():
    exact_m, off_m = sigma_m(0.0), sigma_m(0.03)
    assert exact_m < 0.003
    assert off_m > 5 * exact_m
