import numpy as np
import pytest

from roel_service.config.presets import preset
from roel_service.geometry import projection, segments
from roel_service.io.camera import read_camera
from roel_service.io.events import read_events
from roel_service.io.poses import read_trajectory
from roel_service.mapping.pipeline import build_line_map
from roel_service.scene.events import EventStream

WIDTH, HEIGHT = 240, 180
# An event farther than this from every line is of something else: text, curves, noise.
EXPLAINED_PX = 5.0


def part_of(events, mask):
    return EventStream(
        t_us=events.t_us[mask],
        x=events.x[mask],
        y=events.y[mask],
        polarity=events.polarity[mask],
        width=events.width,
        height=events.height,
    )


def distances_px(line_map, events, trajectory, camera):
    """Distance of each event to the nearest line, projected with the pose at the event's time."""
    table = projection.undistortion_table(camera)
    xy = table[events.y, events.x].astype(float)
    T_camera_world = trajectory.interpolate(events.t_us).inverse()
    nearest = np.empty(len(events))
    for k in range(len(events)):
        projected = projection.project(T_camera_world[k] @ line_map.segments, camera.matrix)
        nearest[k] = np.nanmin(segments.point_segment_distance(xy[k], projected))
    return nearest


@pytest.mark.data
def test_lines_reproject_onto_events_that_were_held_back(data_folder):
    folder = data_folder / "real" / "davis_slider_depth"
    events = read_events(folder / "events_chunk.txt", WIDTH, HEIGHT)
    trajectory = read_trajectory(folder / "groundtruth.txt")
    camera = read_camera(folder / "calib.txt", (WIDTH, HEIGHT))
    held_back = np.arange(len(events)) % 10 == 9

    built = build_line_map(part_of(events, ~held_back), trajectory, camera, preset("default"))
    lines = built.line_map
    assert len(lines) >= 10
    # The camera looks along z; the things on the table are 0.3 to 2 m away.
    depth_m = lines.segments[..., 2]
    assert np.quantile(depth_m, 0.05) > 0.3
    assert np.quantile(depth_m, 0.95) < 2.0

    asked = part_of(events, held_back & trajectory.covers(events.t_us))
    distance_px = distances_px(lines, asked, trajectory, camera)
    explained = distance_px < EXPLAINED_PX
    assert explained.mean() > 0.3
    assert np.median(distance_px[explained]) < 1.5
