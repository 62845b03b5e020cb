import numpy as np
import pytest

from roel_service.geometry import projection
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.mapping.moments import event_forms, segment_forms
from roel_service.mapping.refine_kernels import into_camera

from .synthetic import EXACT_SLOT_US, world


def in_cameras(frames, frame, origin, lines):
    """(S, 6) lines as the cameras see them, from (S, 6) world lines with moments about `origin`."""
    seen = np.empty_like(lines)
    for row, k in enumerate(frame):
        centre = frames.T_world_camera.translation[k] - origin[row]
        R = frames.T_world_camera.rotation[k]
        into_camera(R, *centre, lines[row, :3], lines[row, 3:], seen[row])
    return seen


def explicit_form(world, row, event_count=0, own_poses=True):
    """Mean of a a^T, a = (o x u, u), one event at a time."""
    observations, frames = world.observations, world.frames
    first, last = observations.event_offsets[row], observations.event_offsets[row + 1]
    if event_count:
        last = min(last, first + event_count)
    frame = observations.frame[row]
    form = np.zeros((6, 6))
    for k in range(first, last):
        t_us = frames.t_us[frame] + int(observations.event_dt_us[k])
        own = world.trajectory.interpolate(np.array([t_us]))[0]
        T_frame_own = frames.T_world_camera[frame].inverse() @ own
        if not own_poses:
            T_frame_own = SE3.identity()
        ray = projection.ray_from_pixel(observations.event_xy_px[k].astype(float), frames.K)
        u = T_frame_own.rotate(ray)
        a = np.concatenate([np.cross(T_frame_own.translation, u), u])
        form += np.outer(a, a)
    return form / (last - first)


ROWS = [0, 17, 143, 287]


@pytest.mark.parametrize("event_count", [0, 7, 1_000])
@pytest.mark.parametrize("own_poses", [True, False])
def test_event_forms_are_the_sums_over_events(event_count, own_poses):
    noisy = world(event_noise_px=0.5)
    poses = noisy.trajectory if own_poses else None
    forms = event_forms(noisy.observations, noisy.frames, poses, EXACT_SLOT_US, event_count)
    for row in ROWS:
        expected = explicit_form(noisy, row, event_count, own_poses)
        # Sums of 40 products of numbers up to 1.
        np.testing.assert_allclose(forms[row], expected, rtol=0, atol=1e-13)


def test_slots_share_a_pose():
    exact = world()
    fine, coarse = (
        event_forms(exact.observations, exact.frames, exact.trajectory, slot_us, 0)
        for slot_us in (EXACT_SLOT_US, 500)
    )
    # Half a slot of 250 us at 1.5 m/s, and as many rad: 4e-4 of entries up to 1.
    assert 0 < np.abs(fine - coarse).max() < 1e-3


def test_exact_events_vanish_on_their_line():
    exact = world()
    forms = event_forms(exact.observations, exact.frames, exact.trajectory, EXACT_SLOT_US, 0)
    lines = np.concatenate([exact.lines.direction, exact.lines.moment], axis=1)[exact.line_of]
    y = in_cameras(exact.frames, exact.observations.frame, np.zeros((len(lines), 3)), lines)
    cost = np.einsum("si,sij,sj->s", y, forms, y)
    # Pixels are float32: 4e-6 px at f 120 px is 3e-8 rad at 2.5 m.
    assert cost.max() < (1e-7) ** 2


def test_observations_without_events_have_a_zero_form():
    exact = world(lines=(0,))
    nothing = type(exact.observations)(
        **vars(exact.observations)
        | {
            "event_offsets": np.zeros(len(exact.observations) + 1, np.int64),
            "event_xy_px": np.empty((0, 2), np.float32),
            "event_dt_us": np.empty(0, np.int32),
        }
    )
    forms = event_forms(nothing, exact.frames, exact.trajectory, 500, 0)
    np.testing.assert_array_equal(forms, np.zeros((24, 6, 6)))


def test_segment_forms_hold_three_rays_of_the_segment():
    exact = world()
    forms = segment_forms(exact.observations, exact.frames)
    np.testing.assert_array_equal(forms[:, :3], 0)
    np.testing.assert_array_equal(forms[:, :, :3], 0)
    block = forms[:, 3:, 3:]
    # Unit rays with weights that add up to one.
    np.testing.assert_allclose(np.trace(block, axis1=1, axis2=2), 1.0, rtol=0, atol=1e-14)
    normal = projection.viewing_plane_normal(exact.observations.segments_px, exact.frames.K)
    out_of_plane = np.einsum("si,sij,sj->s", normal, block, normal)
    np.testing.assert_allclose(out_of_plane, 0.0, rtol=0, atol=1e-15)


def test_segment_forms_are_in_squared_pixels_of_the_distance():
    """A line 1 px beside the segment costs 1 px^2 at its middle, near enough."""
    exact = world(lines=(0,))
    shifted = exact.observations.segments_px + 1.0 * np.array([0.0, 1.0])
    along = np.diff(shifted, axis=1)[:, 0]
    slant = np.abs(along[:, 0]) / np.linalg.norm(along, axis=1)
    forms = segment_forms(exact.observations, exact.frames)
    normal = projection.viewing_plane_normal(shifted, exact.frames.K)
    cost = exact.frames.focal_px**2 * np.einsum("si,sij,sj->s", normal, forms[:, 3:, 3:], normal)
    # Distances are angles times f, smaller off the axis: by 1 / (1 + r^2), r up to 0.3.
    np.testing.assert_allclose(np.sqrt(cost), slant, rtol=0.1)


def test_lines_in_the_camera_frame_have_moments_about_its_centre():
    rng = np.random.default_rng(0)
    exact = world()
    frame = np.array([0, 5, 23])
    origin = rng.normal(size=(3, 3))
    point, direction = rng.normal(size=(3, 3)), rotation_from_vector(rng.normal(size=(3, 3)))[:, 0]
    about_origin = np.cross(point - origin, direction)
    lines = np.concatenate([direction, about_origin], axis=1)
    y = in_cameras(exact.frames, frame, origin, lines)
    T_camera_world = exact.frames.T_world_camera[frame].inverse()
    expected_direction = T_camera_world.rotate(direction)
    np.testing.assert_allclose(y[:, :3], expected_direction, rtol=0, atol=1e-14)
    expected_moment = np.cross(T_camera_world @ point, expected_direction)
    np.testing.assert_allclose(y[:, 3:], expected_moment, rtol=0, atol=1e-14)
