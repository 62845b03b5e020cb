"""Questions to a server whose children answer them: the same answers as in process."""

import dataclasses
import hashlib
import json

import cv2
import numpy as np
import pytest

from roel_client import Client
from roel_client.cli.localize import localize
from roel_client.cli.main import parser
from roel_client.cli.register import register
from roel_client.connection import Connection, Endpoint
from roel_service.config.stages import LocalizeConfig, RegisterConfig
from roel_service.errors import (
    Cancelled,
    CloudError,
    ConfigError,
    InputError,
    LimitError,
    NotFoundError,
    PanoramaError,
    PermissionDeniedError,
    RoelError,
    UnavailableError,
)
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.io.clouds import write_npz
from roel_service.io.images import decode_panorama
from roel_service.jobs.batch_inputs import BatchParameters
from roel_service.jobs.batches import run_batch_localize, run_batch_register
from roel_service.pano_loc.hints import PosePrior
from roel_service.pano_loc.localize import localize_panorama, localize_photograph
from roel_service.pano_loc.prepare import prepare_map
from roel_service.progress import ignore
from roel_service.register.register import register_map
from roel_service.register.vertical import Vertical
from roel_service.scene.clouds import PointCloud
from roel_service.scene.results import LocalizationStatus
from roel_service.store.builds import BuiltVersion
from roel_service.store.principals import Role
from roel_service.store.store import Store, opened_principals
from roel_service.v1 import (
    config_pb2,
    localization_pb2,
    localization_pb2_grpc,
    registration_pb2,
    registration_pb2_grpc,
    types_pb2,
)
from roel_service.wire.delimited import delimited, messages
from roel_service.wire.errors import error_from_status
from roel_service.wire.localization import localization_from_proto, localize_request
from roel_service.wire.provenance import Provenance
from roel_service.wire.registration import register_request, registration_from_proto
from roel_service.wire.rlm import decode_map, encode_map

from ..pano_loc.rooms import OTHER_FURNITURE, OTHER_ROOM, map_of, pose, segments_of
from ..pano_loc.test_photograph import CAMERA, FIRST
from ..pano_loc.test_photograph import TRUTH as PHOTOGRAPH
from ..pano_loc.wireframe import wireframe_panorama, wireframe_photograph
from ..register.rooms import room_cloud, room_map
from .processes import Server

ROBOT = Role.LOCALIZE_ONLY
# Coarse, so that a test need not wait.
COARSE = RegisterConfig(voxel_m=0.08, candidate_count=2, max_distance_m=0.15)
FAST = LocalizeConfig(grid_step_m=0.8, crop_px=240, candidate_count=24)
TRUTH = pose(1.7, 1.5, 1.4, 0.05, -0.1, 2.5)
UP = types_pb2.Vector3(z=1.0)
FOUND = localization_pb2.LocalizeResponse.STATUS_FOUND
NOWHERE = "projects/default/maps/nowhere/versions/latest"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return tmp_path_factory.mktemp("server") / "data"


@pytest.fixture(scope="module")
def tokens(data):
    """Tokens of an operator and of a robot that may only ask."""
    with opened_principals(data) as principals:
        return {role: principals.create(role.label, role) for role in (Role.ADMIN, ROBOT)}


MAPS = {
    "room": room_map(),
    "here": map_of(),
    "there": map_of(OTHER_ROOM, OTHER_FURNITURE),
}


@pytest.fixture(scope="module")
def versions(data):
    """Names of versions that are there when the server starts, by their maps."""
    with Store(data) as store:
        for name, line_map in MAPS.items():
            store.maps.create(name)
            rlm_bytes = encode_map(line_map, Provenance())
            store.builds.begin_import(name, store.builds.put_import(rlm_bytes))
            task = store.tasks.lease("test")
            version = BuiltVersion(
                rlm_bytes=rlm_bytes, line_count=len(line_map), bounds_m=[0.0] * 6, report={}
            )
            store.operations.succeed(task.lease, version)
    return {name: f"projects/default/maps/{name}/versions/v1" for name in MAPS}


@pytest.fixture(scope="module")
def version(versions):
    return versions["room"]


@pytest.fixture(scope="module")
def places(versions):
    """The room of the picture, and another one."""
    return [versions["here"], versions["there"]]


@pytest.fixture(scope="module")
def server(data, tokens, versions):
    running = Server(data, interactive_workers=1, interactive_queued=4, inline_point_count=5000)
    yield running
    assert running.stop() == 0


@pytest.fixture(scope="module")
def client(server, tokens):
    with Client(server.address, token=tokens[Role.ADMIN]) as connected:
        yield connected


@pytest.fixture(scope="module")
def connection(server, tokens):
    opened = Connection(Endpoint(address=server.address, token=tokens[Role.ADMIN]))
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory, picture):
    """A room's map, its cloud, a picture, and a first guess, as files."""
    path = tmp_path_factory.mktemp("room")
    (path / "map.rlm").write_bytes(encode_map(room_map(), Provenance()))
    write_npz(path / "cloud.npz", points=room_cloud(count=4000).points)
    T = np.eye(4)
    T[:3, :3] = rotation_from_vector(np.array([0.02, 0.0, 0.05]))
    np.savetxt(path / "T.txt", T)
    (path / "room.png").write_bytes(picture)
    tables = "[register]\nvoxel_m = 0.08\ncandidate_count = 2\n[localize]\ngrid_step_m = 0.8\n"
    tables += "crop_px = 240\ncandidate_count = 24\n"
    (path / "coarse.toml").write_text(tables)
    return path


@pytest.fixture(scope="module")
def line_map(folder):
    return decode_map((folder / "map.rlm").read_bytes()).line_map


@pytest.fixture(scope="module")
def cloud(client, folder):
    return client.upload_blob(folder / "cloud.npz")


@pytest.fixture(scope="module")
def call(connection):
    stub = registration_pb2_grpc.RegistrationServiceStub(connection.channel)

    def called(version, **fields):
        request = registration_pb2.RegisterRequest(map_version=version, **fields)
        return connection.call(stub.Register, request, timeout_s=60.0)

    return called


def assert_equal(answer, result):
    """Bit for bit."""
    found = registration_from_proto(answer)
    for item in dataclasses.fields(result):
        here, there = getattr(result, item.name), getattr(found, item.name)
        if item.name == "T_target_source":
            np.testing.assert_array_equal(there.matrix(), here.matrix())
        elif item.name == "alternatives":
            assert [other.score for other in there] == [other.score for other in here]
        else:
            np.testing.assert_array_equal(there, here)


@pytest.fixture(scope="module")
def picture():
    """What a panorama shows of the room with the furniture, as a PNG file."""
    drawn = wireframe_panorama(TRUTH, segments_of(), 768)
    return cv2.imencode(".png", drawn)[1].tobytes()


class TestLocalize:
    def test_a_picture_has_the_answer_that_it_has_in_process(self, client, places, picture):
        answer = client.localize(places, picture, config=FAST)
        line_maps = [decode_map(client.download_map(name)).line_map for name in places]
        maps = [prepare_map(line_map, FAST) for line_map in line_maps]
        here = localize_panorama(decode_panorama(picture), maps, FAST)
        there = localization_from_proto(answer)
        assert here.status is there.status is LocalizationStatus.FOUND
        assert (there.score, there.margin) == (here.score, pytest.approx(here.margin))
        assert len(there.hypotheses) == len(here.hypotheses)
        for found, expected in zip(there.hypotheses, here.hypotheses, strict=True):
            np.testing.assert_array_equal(
                found.T_world_panorama.matrix(), expected.T_world_panorama.matrix()
            )
            np.testing.assert_array_equal(found.covariance, expected.covariance)
            assert found.map_index == expected.map_index
        assert list(answer.map_versions) == places
        assert answer.hypotheses[0].map_version == places[0]
        assert answer.diagnostics.arc_count == here.arc_count
        assert set(answer.stage_seconds) == {"decode", "prepare", "localize"}

    def test_maps_stay_warm_and_hypotheses_are_as_many_as_asked_for(self, client, places, picture):
        answer = client.localize(
            places, picture, T_prior=TRUTH, max_hypothesis_count=1, config=FAST
        )
        assert answer.stage_seconds["prepare"] < 0.05
        assert len(answer.hypotheses) == 1

    def test_a_photograph_has_a_camera_and_a_prior(self, client, places):
        drawn = wireframe_photograph(PHOTOGRAPH, segments_of(), CAMERA)
        image = cv2.imencode(".png", drawn)[1].tobytes()
        answer = client.localize(places[:1], image, camera=CAMERA, T_prior=FIRST)
        stored = decode_map(encode_map(MAPS["here"], Provenance())).line_map
        maps = [prepare_map(stored, LocalizeConfig())]
        prior = PosePrior(T_world_picture=FIRST)
        here = localize_photograph(drawn, CAMERA, maps, LocalizeConfig(), prior=prior)
        there = localization_from_proto(answer)
        assert here.status is there.status is LocalizationStatus.FOUND
        np.testing.assert_array_equal(
            there.T_world_panorama.matrix(), here.T_world_panorama.matrix()
        )

    def test_a_picture_of_another_place_is_not_found_there(self, client, places, picture):
        answer = client.localize(places[1:], picture, config=FAST)
        assert answer.status == localization_pb2.LocalizeResponse.STATUS_NOT_FOUND
        assert (answer.reason, len(answer.hypotheses)) == ("NOT_IN_MAP", 0)

    @pytest.mark.parametrize(
        ("fields", "error", "message"),
        [
            ({}, InputError, "picture: expected image or image_blob, found none"),
            ({"map_versions": []}, InputError, "map_versions: expected 1 to 8 versions, found 0"),
            ({"map_versions": [NOWHERE] * 9}, InputError, "1 to 8 versions, found 9"),
            ({"max_hypothesis_count": 6}, InputError, "max_hypothesis_count: expected 0 to 5"),
            ({"up_world": types_pb2.Vector3(z=1.0)}, InputError, "together, found up_world alone"),
            (
                {"up_world": types_pb2.Vector3(z=1.0), "up_panorama": types_pb2.Vector3(z=2.0)},
                InputError,
                "up_panorama: expected a unit vector, found one of length 2",
            ),
            ({"up_sigma_deg": 100.0, "up_world": UP, "up_panorama": UP}, InputError, "0 to 90"),
            ({"preset": "paper"}, ConfigError, "preset: expected default, found paper"),
            ({"camera": types_pb2.Camera()}, InputError, "prior: expected a first pose, as there"),
            ({"prior": types_pb2.Transform()}, InputError, "prior: expected 9 numbers"),
            ({"image": b"GIF89a"}, PanoramaError, "image: expected a JPEG or PNG picture"),
            ({"image_blob": types_pb2.BlobRef(sha256="0" * 64)}, NotFoundError, "blob"),
        ],
    )
    def test_requests_that_cannot_be_answered_are_refused(
        self, connection, places, fields, error, message
    ):
        stub = localization_pb2_grpc.LocalizationServiceStub(connection.channel)
        request = localization_pb2.LocalizeRequest(**{"map_versions": places, **fields})
        with pytest.raises(error, match=message):
            connection.call(stub.Localize, request, timeout_s=60.0)

    def test_who_may_only_localize_gets_poses_and_no_maps(self, server, tokens, places, picture):
        with Client(server.address, token=tokens[ROBOT]) as robot:
            assert robot.localize(places, picture, config=FAST).map_versions == places
            with pytest.raises(PermissionDeniedError):
                robot.download_map(places[0])


class TestRegister:
    def test_a_cloud_has_the_answer_that_it_has_in_process(self, client, version, cloud, line_map):
        T_init = SE3(
            rotation=rotation_from_vector(np.array([0.0, 0.1, 0.2])), translation=np.ones(3) / 9
        )
        answer = client.register(version, cloud, T_init=T_init, config=COARSE)
        points = PointCloud(points=room_cloud(count=4000).points)
        assert_equal(answer, register_map(line_map, points, COARSE, T_init=T_init))
        assert answer.map_version == version
        assert answer.verdict == registration_pb2.RegisterResponse.VERDICT_ACCEPTED
        assert (np.diff(answer.eigenvalues) >= 0.0).all()

    def test_the_verticals_of_both_sides_guide_a_search(self, client, version, cloud, line_map):
        up, down = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])
        answer = client.register(
            version, cloud, method="global", up_source=up, up_target=down, config=COARSE
        )
        points = PointCloud(points=room_cloud(count=4000).points)
        vertical = Vertical(up_source=up, up_target=down)
        expected = register_map(line_map, points, COARSE, method="global", vertical=vertical)
        assert_equal(answer, expected)
        assert expected.T_target_source.rotation[2, 2] < -0.9

    def test_points_in_the_request_are_as_good_as_a_file(self, client, version, cloud):
        points = room_cloud(count=4000).points
        answers = [client.register(version, target, config=COARSE) for target in (points, cloud)]
        assert_equal(answers[0], registration_from_proto(answers[1]))

    def test_a_cloud_is_prepared_once(self, client, version, cloud):
        config = dataclasses.replace(COARSE, voxel_m=0.07)
        first, second = (client.register(version, cloud, config=config) for _ in range(2))
        assert second.preparation_seconds < first.preparation_seconds / 5

    def test_another_map_can_be_the_target(self, client, version, line_map):
        latest = version.replace("/v1", "/latest")
        answer = client.register(version, latest, config=COARSE)
        assert_equal(answer, register_map(line_map, line_map, COARSE))
        assert answer.target_map_version == version

    def test_scale_is_estimated_when_asked_for(self, call, version, cloud):
        coarse = config_pb2.RegisterConfig(voxel_m=0.08, candidate_count=2)
        answer = call(version, cloud=cloud, estimate_scale=True, config=coarse)
        assert answer.scale == pytest.approx(1.0, abs=0.01)
        assert answer.scale != 1.0

    def test_a_bad_cloud_is_told_without_paths(self, client, version, tmp_path):
        (tmp_path / "cloud.npz").write_bytes(b"no cloud at all")
        with pytest.raises(CloudError) as caught:
            client.register(version, client.upload_blob(tmp_path / "cloud.npz"))
        assert caught.value.subject == "cloud"
        with pytest.raises(CloudError, match="points: expected at least 100 finite points"):
            client.register(version, np.full((200, 3), np.nan))

    @pytest.mark.parametrize(
        ("fields", "error", "message"),
        [
            ({}, InputError, "target: expected points, cloud or target_map_version, found none"),
            ({"method": 17}, InputError, "method: expected one of auto, point"),
            ({"method": 5, "init": types_pb2.Transform()}, InputError, "init: expected no first"),
            ({"init": types_pb2.Transform()}, InputError, "init: expected 9 numbers"),
            (
                {"up_source": types_pb2.Vector3(z=1.0)},
                InputError,
                "up_source and up_target together",
            ),
            (
                {"up_source": types_pb2.Vector3(z=2.0), "up_target": types_pb2.Vector3(z=1.0)},
                InputError,
                "up_source: expected a unit vector",
            ),
            ({"preset": "best"}, ConfigError, "expected one of default"),
            ({"points": types_pb2.Points(points_m=b"123")}, InputError, "points: expected rows"),
            ({"points": types_pb2.Points(points_m=bytes(5001 * 12))}, LimitError, "at most 5000"),
            (
                {"cloud": types_pb2.BlobRef(sha256=hashlib.sha256().hexdigest())},
                NotFoundError,
                "blob",
            ),
            ({"target_map_version": NOWHERE}, NotFoundError, "nowhere"),
        ],
    )
    def test_requests_that_cannot_be_answered_are_refused(
        self, call, version, fields, error, message
    ):
        target = {} if not fields else {"points": types_pb2.Points()}
        with pytest.raises(error, match=message):
            call(version, **{**target, **fields})

    def test_a_caller_who_goes_away_frees_the_child(self, client, version, cloud, line_map):
        # A thousand guesses are followed up, which takes many times as long as the caller waits.
        endless = dataclasses.replace(
            COARSE, voxel_m=0.01, candidate_count=1000, gravity_aligned=False
        )
        with pytest.raises(UnavailableError):
            client.register(version, cloud, method="global", config=endless, timeout_s=0.1)
        assert client.register(version, cloud, config=COARSE).converged


class TestStream:
    def test_pictures_are_answered_in_order_and_a_bad_one_ends_nothing(
        self, client, places, picture
    ):
        with client.localizing(places[:1], T_prior=TRUTH, config=FAST) as stream:
            assert (stream.map_versions, stream.credit_pictures) == (places[:1], 4)
            for picture_id, image in ((7, picture), (3, b"no picture"), (5, picture)):
                stream.send(picture_id, image)
            stream.finish()
            answers = list(iter(stream.receive, None))
        assert [answer.picture_id for answer in answers] == [7, 3, 5]
        assert [answer.WhichOneof("outcome") for answer in answers] == [
            "response",
            "error",
            "response",
        ]
        assert error_from_status(answers[1].error).reason == "PANORAMA_INVALID"
        found = [localization_from_proto(answers[index].response) for index in (0, 2)]
        assert [result.status for result in found] == [LocalizationStatus.FOUND] * 2
        np.testing.assert_array_equal(
            found[0].T_world_panorama.matrix(), found[1].T_world_panorama.matrix()
        )

    def test_a_picture_may_have_a_prior_of_its_own(self, client, places, picture):
        far = SE3(rotation=TRUTH.rotation, translation=TRUTH.translation + 9.0)
        with client.localizing(places[:1], T_prior=TRUTH, config=FAST) as stream:
            stream.send(1, picture, T_prior=far)
            assert stream.receive().response.status != FOUND
            stream.send(2, picture)
            assert stream.receive().response.status == FOUND

    @pytest.mark.parametrize(
        ("requests", "message"),
        [
            ([], "stream: expected a message that says where to look, found none"),
            ([{"picture": {}}], "expected a message with setup, found picture"),
            ([{"setup": {"map_versions": [NOWHERE]}}], "nowhere"),
        ],
    )
    def test_a_stream_begins_with_its_setup(self, connection, requests, message):
        stub = localization_pb2_grpc.LocalizationServiceStub(connection.channel)
        messages = [localization_pb2.StreamLocalizeRequest(**fields) for fields in requests]
        with pytest.raises(RoelError, match=message):
            list(connection.stream(stub.StreamLocalize, iter(messages)))


@pytest.fixture(scope="module")
def requests(places, picture):
    """A picture that is found, one that is none, and one of a map that is not there."""
    asked = []
    for name, image in ((places[0], picture), (places[0], b"no picture"), (NOWHERE, picture)):
        request = localize_request([name], T_prior=TRUTH, config=FAST)
        request.image = image
        asked.append(request)
    return asked


def batch(data, manifest, item_count, journal, earlier_journals=()):
    return BatchParameters(
        folder=data,
        manifest=manifest,
        item_count=item_count,
        max_item_bytes=2**22,
        journal=journal,
        earlier_journals=earlier_journals,
        cache=None,
        inline_point_count=0,
    )


class TestBatch:
    def test_every_request_has_its_answer_or_its_error(self, client, requests, places):
        answer = client.batch_localize(requests).wait()
        assert (answer.item_count, answer.failed_count) == (3, 2)
        found, *failed = client.batch_items(answer)
        assert (found.index, found.response.status) == (0, FOUND)
        assert found.response.map_versions == places[:1]
        reasons = [error_from_status(item.error).reason for item in failed]
        assert reasons == ["PANORAMA_INVALID", "NOT_FOUND"]

    @pytest.mark.parametrize(
        ("fields", "error", "message"),
        [
            ({}, InputError, "requests: expected requests or a manifest, found both or none"),
            ({"parent": "projects/other"}, NotFoundError, "parent"),
            ({"manifest": types_pb2.BlobRef(sha256="0" * 64)}, NotFoundError, "blob"),
        ],
    )
    def test_batches_that_cannot_begin_are_refused(self, connection, fields, error, message):
        stub = localization_pb2_grpc.LocalizationServiceStub(connection.channel)
        request = localization_pb2.BatchLocalizeRequest(**{"parent": "projects/default", **fields})
        with pytest.raises(error, match=message):
            connection.call(stub.BatchLocalize, request)

    def test_a_manifest_that_is_none_is_refused(self, client, connection, tmp_path):
        (tmp_path / "manifest").write_bytes(b"\x07short")
        blob = client.upload_blob(tmp_path / "manifest")
        stub = localization_pb2_grpc.LocalizationServiceStub(connection.channel)
        request = localization_pb2.BatchLocalizeRequest(parent="projects/default", manifest=blob)
        with pytest.raises(InputError, match="expected 7 bytes, found 5 at message 0") as caught:
            connection.call(stub.BatchLocalize, request)
        assert caught.value.reason == "MANIFEST_INVALID"

    def test_an_attempt_goes_on_where_the_best_one_before_it_ended(self, data, requests, tmp_path):
        manifest = tmp_path / "manifest"
        manifest.write_bytes(b"".join(map(delimited, requests)))

        def attempt(name, earlier=(), end_at=9):
            earlier_journals = [tmp_path / path for path in earlier]
            parameters = batch(data, manifest, 3, tmp_path / name, earlier_journals)
            told = []

            def tell(progress):
                told.append((progress.done_count, progress.cached_count))
                if progress.done_count == end_at:
                    raise Cancelled

            return run_batch_localize(parameters, tell), told

        whole, told = attempt("whole")
        assert told == [(0, 0), (1, 0), (2, 0)]
        with pytest.raises(Cancelled):
            attempt("first", end_at=2)
        # The last item was being written.
        torn = (tmp_path / "first").read_bytes()
        (tmp_path / "torn").write_bytes(torn[:-3])
        resumed, told = attempt("second", ["torn"])
        assert told == [(1, 1), (2, 1)]
        resumed, told = attempt("third", ["torn", "first"])
        assert told == [(2, 2)]
        assert (resumed.item_count, resumed.failed_count) == (3, whole.failed_count)
        assert (tmp_path / "third").read_bytes().startswith(torn)

    def test_registrations_are_batched_alike(self, data, version, cloud, tmp_path):
        asked = [register_request(name, cloud, config=COARSE) for name in (version, NOWHERE)]
        (tmp_path / "manifest").write_bytes(b"".join(map(delimited, asked)))
        done = run_batch_register(batch(data, tmp_path / "manifest", 2, tmp_path / "items"), ignore)
        assert (done.item_count, done.failed_count) == (2, 1)
        with done.journal.open("rb") as file:
            first, second = messages(
                file, registration_pb2.BatchRegisterItem, subject="items", max_bytes=2**22
            )
        assert first.response.map_version == version
        assert error_from_status(second.error).reason == "NOT_FOUND"


@pytest.mark.parametrize("command", [register, localize])
def test_the_command_asks_a_server(server, tokens, version, folder, monkeypatch, capsys, command):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("ROEL_TOKEN", tokens[Role.ADMIN])
    target = "cloud.npz" if command is register else "room.png"
    guess = "--init" if command is register else "--prior"
    line = [target, guess, "T.txt", "--config", "coarse.toml"]
    printed = []
    for where in (["map.rlm"], [version, "--server", server.address]):
        command(parser().parse_args([command.__name__, *where, *line]), {})
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1] != ""


def test_a_batch_of_files_has_the_same_rows_here_and_on_a_server(
    server, tokens, version, folder, capsys, monkeypatch
):
    monkeypatch.setenv("ROEL_TOKEN", tokens[Role.ADMIN])
    (folder / "manifest.txt").write_text("room.png\nT.txt\n")
    rows = []
    for where in ([folder / "map.rlm"], [version, "--server", server.address]):
        out = folder / f"rows-{len(where)}.jsonl"
        line = ["batch", "localize", folder / "manifest.txt", "--out", out, "--maps", *where]
        line += ["--config", folder / "coarse.toml", "--workers", "1", "--json"]
        options = parser().parse_args(list(map(str, line)))
        options.command.run(options, {})
        assert json.loads(capsys.readouterr().out)["failed_count"] == 1
        rows.append([json.loads(text) for text in out.read_text().splitlines()])
        assert not out.with_name(f"{out.name}.partial").exists()
    for row in (*rows[0], *rows[1]):
        row["seconds"] = row["map"] = None
    assert rows[0] == rows[1]
    assert [row["reason"] for row in rows[0]][1] == "PANORAMA_INVALID"
