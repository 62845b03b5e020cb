import json

import h5py
import hdf5plugin
import numpy as np
import pytest
import yaml

from roel_bench.datasets import open_replica, open_tum_vie, open_vector
from roel_service.errors import CameraError, InputError, MeshError, TrajectoryError
from roel_service.geometry.projection import CameraModel
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.io.poses import write_trajectory
from roel_service.scene.events import concatenate
from roel_service.scene.trajectory import Trajectory

# As VECtor's: seconds since 1970.
EPOCH_US = 1_643_091_527_996_090


def random_poses(count, seed=0):
    rng = np.random.default_rng(seed)
    rotation = rotation_from_vector(rng.uniform(-1, 1, (count, 3)))
    return SE3(rotation=rotation, translation=rng.uniform(-2, 2, (count, 3)))


CAMERA_POSES = random_poses(5)
# Every 8333 us, as motion capture at 120 Hz.
T_US = 1000 + 8333 * np.arange(5)


def write_events(path, width, height, t_offset_us=None):
    """The columns of both publishers: relative times, and what brings them on the poses' clock."""
    rng = np.random.default_rng(0)
    columns = {
        "x": rng.integers(0, width, 50).astype("u2"),
        "y": rng.integers(0, height, 50).astype("u2"),
        "t": np.sort(rng.integers(0, 30_000, 50)).astype("u4"),
        "p": rng.integers(0, 2, 50).astype("u1"),
    }
    with h5py.File(path, "w") as file:
        for name, column in columns.items():
            file.create_dataset(f"events/{name}", data=column, **hdf5plugin.Zstd())
        file.create_dataset("ms_to_idx", data=np.searchsorted(columns["t"], np.arange(30) * 1000))
        if t_offset_us is not None:
            file.create_dataset("t_offset", shape=(1,), dtype="i8", data=t_offset_us)
    return columns


def pose_values(pose):
    return [*pose.translation.tolist(), *pose.quaternion_xyzw().tolist()]


def assert_poses(trajectory, poses, t_us):
    np.testing.assert_array_equal(trajectory.t_us, t_us)
    # Text of 12 digits.
    np.testing.assert_allclose(trajectory.T_world_camera.matrix(), poses.matrix(), atol=1e-10)


def assert_events(scene, columns, t_offset_us=0):
    stream = concatenate(list(scene.events.chunks()))
    np.testing.assert_array_equal(stream.x, columns["x"])
    np.testing.assert_array_equal(stream.y, columns["y"])
    np.testing.assert_array_equal(stream.t_us, columns["t"].astype(np.int64) + t_offset_us)
    np.testing.assert_array_equal(stream.polarity, 2 * columns["p"].astype(int) - 1)


def camera_text(poses):
    """Poses of the camera itself, as DEVO's."""
    return "".join(
        f"{t / 1e6:.6f} " + " ".join(f"{v:.12g}" for v in pose_values(pose)) + "\n"
        for t, pose in zip(T_US, poses, strict=True)
    )


class TestTumVie:
    T_IMU_MARKER, T_IMU_CAMERA = random_poses(2, seed=1)

    def basalt(self, pose):
        return dict(zip(("px", "py", "pz", "qx", "qy", "qz", "qw"), pose_values(pose), strict=True))

    def folder(self, path, sequence="mocap-desk2", letter="A", seconds=False):
        """As downloaded, with archives unpacked."""
        camera = {
            "camera_type": "kb4",
            "intrinsics": {
                "fx": 1049.6,
                "fy": 1049.5,
                "cx": 632.3,
                "cy": 368.9,
                "k1": -0.1,
                "k2": 0.02,
                "k3": -0.03,
                "k4": 0.004,
            },
        }
        other = {"camera_type": "kb4", "intrinsics": dict.fromkeys(camera["intrinsics"], 1.0)}
        identity = self.basalt(SE3.identity())
        calibration = {
            "T_imu_cam": [identity, identity, self.basalt(self.T_IMU_CAMERA), identity],
            "intrinsics": [other, other, camera, other],
            "resolution": [[1024, 1024], [1024, 1024], [1280, 720], [1280, 720]],
        }
        (path / f"camera-calibration{letter}.json").write_text(json.dumps({"value0": calibration}))
        mocap = {"T_imu_marker": self.basalt(self.T_IMU_MARKER), "mocap_to_imu_offset_ns": 0}
        (path / f"mocap-imu-calibration{letter}.json").write_text(json.dumps({"value0": mocap}))
        (path / f"{sequence}-vi_gt_data").mkdir()
        lines = ["# timestamp(us) px(m) py(m) pz(m) qx qy qz qw"]
        for t_us, pose in zip(T_US, self.marker_poses(), strict=True):
            time = f"{t_us / 1e6:.6f}" if seconds else f"{t_us}"
            lines.append(" ".join([time, *(f"{value:.12g}" for value in pose_values(pose))]))
        poses_file = path / f"{sequence}-vi_gt_data" / "mocap_data.txt"
        poses_file.write_text("\n".join(lines) + "\n")
        self.events = write_events(path / f"{sequence}-events_left.h5", 1280, 720)
        return path

    def marker_poses(self):
        return CAMERA_POSES @ self.T_IMU_CAMERA.inverse() @ self.T_IMU_MARKER

    def test_poses_are_those_of_the_left_event_camera(self, tmp_path):
        scene = open_tum_vie(self.folder(tmp_path), "mocap-desk2")
        assert_poses(scene.trajectory, CAMERA_POSES, T_US)
        assert scene.name == "tum_vie_mocap-desk2"
        assert scene.truth is None

    def test_the_camera_is_the_fisheye_of_the_left_event_camera(self, tmp_path):
        camera = open_tum_vie(self.folder(tmp_path), "mocap-desk2").camera
        assert (camera.width, camera.height) == (1280, 720)
        assert (camera.fx_px, camera.fy_px) == (1049.6, 1049.5)
        assert (camera.cx_px, camera.cy_px) == (632.3, 368.9)
        assert camera.model is CameraModel.FISHEYE
        assert camera.distortion == (-0.1, 0.02, -0.03, 0.004)

    def test_events_are_read_on_the_clock_of_the_poses(self, tmp_path):
        assert_events(open_tum_vie(self.folder(tmp_path), "mocap-desk2"), self.events)

    def test_times_in_seconds_are_understood(self, tmp_path):
        scene = open_tum_vie(self.folder(tmp_path, seconds=True), "mocap-desk2")
        assert_poses(scene.trajectory, CAMERA_POSES, T_US)

    def test_other_sequences_have_the_other_calibration(self, tmp_path):
        scene = open_tum_vie(self.folder(tmp_path, "mocap-6dof", "B"), "mocap-6dof")
        assert_poses(scene.trajectory, CAMERA_POSES, T_US)

    def test_estimated_poses_take_the_place_of_motion_capture(self, tmp_path):
        folder = self.folder(tmp_path)
        (folder / "devo.txt").write_text(camera_text(CAMERA_POSES))
        (folder / "mocap-imu-calibrationA.json").unlink()
        scene = open_tum_vie(folder, "mocap-desk2", poses=folder / "devo.txt")
        assert_poses(scene.trajectory, CAMERA_POSES, T_US)

    @pytest.mark.parametrize(
        "missing",
        [
            "mocap-desk2-events_left.h5",
            "mocap-desk2-vi_gt_data/mocap_data.txt",
            "camera-calibrationA.json",
            "mocap-imu-calibrationA.json",
        ],
    )
    def test_a_missing_file_is_named(self, tmp_path, missing):
        folder = self.folder(tmp_path)
        (folder / missing).unlink()
        with pytest.raises(InputError, match=f"{missing}: expected a readable file"):
            open_tum_vie(folder, "mocap-desk2")

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda c: c["intrinsics"][2].update(camera_type="ds"), "camera 2 of type kb4.* 'ds'"),
            (
                lambda c: c["intrinsics"][2]["intrinsics"].pop("k4"),
                r"value value0\.intrinsics\.2\.intrinsics\.k4, found none",
            ),
            (lambda c: c["resolution"].clear(), r"value0\.resolution\.2\.0, found none"),
            (
                lambda c: c["T_imu_cam"][2].update(px="1"),
                r"a number value0\.T_imu_cam\.2\.px, found '1'",
            ),
        ],
    )
    def test_a_calibration_of_another_form_is_told(self, tmp_path, change, message):
        folder = self.folder(tmp_path)
        path = folder / "camera-calibrationA.json"
        document = json.loads(path.read_text())
        change(document["value0"])
        path.write_text(json.dumps(document))
        with pytest.raises(CameraError, match=message):
            open_tum_vie(folder, "mocap-desk2")

    def test_quaternions_off_unit_norm_are_refused(self, tmp_path):
        folder = self.folder(tmp_path)
        path = folder / "mocap-desk2-vi_gt_data" / "mocap_data.txt"
        path.write_text(path.read_text() + "90000 0 0 0 0 0 0 2\n")
        with pytest.raises(TrajectoryError, match="quaternions of norm 1, found 2"):
            open_tum_vie(folder, "mocap-desk2")

    def test_text_that_is_no_json_is_refused(self, tmp_path):
        folder = self.folder(tmp_path)
        (folder / "camera-calibrationA.json").write_text("{")
        with pytest.raises(CameraError, match="expected JSON"):
            open_tum_vie(folder, "mocap-desk2")


class TestVector:
    T_CAM0_BODY, T_CAM0_CAMERA = random_poses(2, seed=2)

    def folder(self, path):
        write = {
            "left_event_camera_intrinsic_results.yaml": {
                "image_width": 640,
                "image_height": 480,
                "camera_name": "left_event_camera",
                "camera_matrix": {
                    "rows": 3,
                    "cols": 3,
                    "data": [327.3, 0.0, 304.3, 0.0, 327.5, 235.0, 0.0, 0.0, 1.0],
                },
                "distortion_model": "plumb_bob",
                "distortion_coefficients": {
                    "rows": 1,
                    "cols": 5,
                    "data": [-0.03, 0.004, -0.0002, 0.0007, -0.001],
                },
            },
            "camera_mocap_extrinsic_results1.yaml": {
                "cam0": {
                    "camera_name": "left_regular_camera",
                    "T_body_cam": self.T_CAM0_BODY.inverse().matrix().ravel().tolist(),
                    "T_cam_body": self.T_CAM0_BODY.matrix().ravel().tolist(),
                }
            },
            "small_scale_joint_camera_extrinsic_results.yaml": {
                "cam0": {"camera_name": "left_regular_camera"},
                "cam2": {"T_cam0_cam2": self.T_CAM0_CAMERA.matrix().ravel().tolist()},
            },
        }
        for name, document in write.items():
            (path / name).write_text(yaml.safe_dump(document))
        body = Trajectory(
            t_us=T_US + EPOCH_US,
            T_world_camera=CAMERA_POSES @ self.T_CAM0_CAMERA.inverse() @ self.T_CAM0_BODY,
        )
        write_trajectory(path / "desk_normal1.synced.gt.txt", body)
        self.events = write_events(
            path / "desk_normal1.synced.left_event.hdf5", 640, 480, t_offset_us=EPOCH_US
        )
        return path

    def test_poses_are_those_of_the_left_event_camera(self, tmp_path):
        scene = open_vector(self.folder(tmp_path), "desk_normal1")
        assert_poses(scene.trajectory, CAMERA_POSES, T_US + EPOCH_US)
        assert scene.name == "vector_desk_normal1"

    def test_events_and_camera_are_as_published(self, tmp_path):
        scene = open_vector(self.folder(tmp_path), "desk_normal1")
        assert_events(scene, self.events, EPOCH_US)
        assert (scene.camera.width, scene.camera.height) == (640, 480)
        assert (scene.camera.fx_px, scene.camera.cy_px) == (327.3, 235.0)
        assert scene.camera.distortion == (-0.03, 0.004, -0.0002, 0.0007, -0.001)

    def test_estimated_poses_take_the_place_of_motion_capture(self, tmp_path):
        folder = self.folder(tmp_path)
        (folder / "devo.txt").write_text(camera_text(CAMERA_POSES))
        (folder / "desk_normal1.synced.gt.txt").unlink()
        scene = open_vector(folder, "desk_normal1", poses=folder / "devo.txt")
        assert_poses(scene.trajectory, CAMERA_POSES, T_US)

    @pytest.mark.parametrize(
        ("name", "document", "error", "message"),
        [
            ("camera_mocap_extrinsic_results1", {"cam0": {}}, CameraError, "T_cam_body.0, found"),
            (
                "small_scale_joint_camera_extrinsic_results",
                {"cam2": {"T_cam0_cam2": list(range(15))}},
                CameraError,
                r"cam2\.T_cam0_cam2\.15, found none",
            ),
            (
                "small_scale_joint_camera_extrinsic_results",
                {"cam2": {"T_cam0_cam2": [2.0 * (i % 5 == 0) for i in range(16)]}},
                TrajectoryError,
                "rigid transforms",
            ),
        ],
    )
    def test_extrinsics_of_another_form_are_told(self, tmp_path, name, document, error, message):
        folder = self.folder(tmp_path)
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(document))
        with pytest.raises(error, match=rf"{name}\.yaml: .*{message}"):
            open_vector(folder, "desk_normal1")

    def test_text_that_is_no_yaml_is_refused(self, tmp_path):
        folder = self.folder(tmp_path)
        (folder / "camera_mocap_extrinsic_results1.yaml").write_text("cam0: [")
        with pytest.raises(CameraError, match="expected YAML"):
            open_vector(folder, "desk_normal1")


MESH = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
1 1 0
0 1 0
4 0 1 2 3
"""


class TestReplica:
    def folder(self, path, events="events.h5"):
        camera = {
            "w": 1200,
            "h": 680,
            "fx": 600.0,
            "fy": 600.0,
            "cx": 599.5,
            "cy": 339.5,
            "scale": 6553.5,
        }
        (path / "cam_params.json").write_text(json.dumps({"camera": camera}))
        (path / "office4_mesh.ply").write_text(MESH)
        (path / "office4").mkdir()
        lines = [
            " ".join(f"{value:.12e}" for value in matrix.ravel())
            for matrix in CAMERA_POSES.matrix()
        ]
        (path / "office4" / "traj.txt").write_text("\n".join(lines) + "\n")
        self.events = write_events(path / "office4" / events, 1200, 680)
        return path

    def test_lines_of_the_trajectory_come_a_hundred_times_a_second(self, tmp_path):
        scene = open_replica(self.folder(tmp_path), "office4")
        assert_poses(scene.trajectory, CAMERA_POSES, 10_000 * np.arange(5))
        assert scene.name == "replica_office4"

    def test_the_rate_is_the_callers_to_say(self, tmp_path):
        folder = self.folder(tmp_path)
        scene = open_replica(folder, "office4", rate_hz=500.0)
        np.testing.assert_array_equal(scene.trajectory.t_us, 2_000 * np.arange(5))
        with pytest.raises(TrajectoryError, match=r"rate_hz: expected > 0, found 0"):
            open_replica(folder, "office4", rate_hz=0.0)

    def test_poses_with_times_take_the_place_of_those_without(self, tmp_path):
        folder = self.folder(tmp_path)
        poses = Trajectory(t_us=T_US, T_world_camera=random_poses(5, seed=3))
        write_trajectory(folder / "office4" / "poses.txt", poses)
        scene = open_replica(folder, "office4")
        assert_poses(scene.trajectory, poses.T_world_camera, T_US)

    def test_camera_events_and_mesh_are_those_of_the_scene(self, tmp_path):
        scene = open_replica(self.folder(tmp_path), "office4")
        assert (scene.camera.width, scene.camera.height) == (1200, 680)
        assert (scene.camera.fx_px, scene.camera.cx_px, scene.camera.cy_px) == (600, 599.5, 339.5)
        assert_events(scene, self.events)
        # A square, as NICE-SLAM's meshes have them, is two triangles.
        assert len(scene.truth.mesh) == 2
        assert scene.truth.edges is None

    def test_events_may_lie_elsewhere(self, tmp_path):
        folder = self.folder(tmp_path, events="vid2e.h5")
        assert_events(
            open_replica(folder, "office4", events=folder / "office4" / "vid2e.h5"), self.events
        )
        with pytest.raises(InputError, match=r"events\.h5: expected a readable file"):
            open_replica(folder, "office4")

    def test_rotations_lost_in_print_are_made_whole(self, tmp_path):
        folder = self.folder(tmp_path)
        matrices = np.round(CAMERA_POSES.matrix(), 4)
        np.savetxt(folder / "office4" / "traj.txt", matrices.reshape(-1, 16), fmt="%.4f")
        rotation = open_replica(folder, "office4").trajectory.T_world_camera.rotation
        np.testing.assert_allclose(
            rotation @ np.swapaxes(rotation, 1, 2),
            np.broadcast_to(np.eye(3), (5, 3, 3)),
            atol=1e-12,
        )
        np.testing.assert_allclose(rotation, CAMERA_POSES.rotation, atol=2e-4)

    @pytest.mark.parametrize(
        "matrix", [-np.eye(4), np.diag([2.0, 1, 1, 1]), np.ones((4, 4)), np.zeros((4, 4))]
    )
    def test_matrices_that_are_no_poses_are_refused(self, tmp_path, matrix):
        folder = self.folder(tmp_path)
        np.savetxt(folder / "office4" / "traj.txt", np.stack([np.eye(4), matrix]).reshape(-1, 16))
        with pytest.raises(TrajectoryError, match=r"traj\.txt: expected 4x4 matrices of rigid"):
            open_replica(folder, "office4")

    def test_a_mesh_without_faces_is_refused(self, tmp_path):
        folder = self.folder(tmp_path)
        points = MESH.replace("element face 1", "element face 0").replace("4 0 1 2 3\n", "")
        (folder / "office4_mesh.ply").write_text(points)
        with pytest.raises(MeshError, match="office4_mesh"):
            open_replica(folder, "office4")
