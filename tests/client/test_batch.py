"""Batches of pictures: manifests, what survives an interruption, and the table."""

import asyncio
import json

import numpy as np
import pytest

from roel_client.batch import Journal, locate_all, read_manifest, write_table
from roel_service.errors import InputError, PanoramaError, UnavailableError
from roel_service.geometry.se3 import SE3
from roel_service.progress import ignore
from roel_service.scene.results import LocalizationStatus, PanoLocResult, PoseHypothesis

ASKED = {"maps": ["0" * 64]}


@pytest.fixture
def manifest(tmp_path):
    path = tmp_path / "manifest.txt"
    prior = np.eye(4).tolist()
    lines = ["# a walk", "a.jpg", "", "b.jpg", json.dumps({"panorama": "c.jpg", "prior": prior})]
    path.write_text("\n".join(lines))
    return path


@pytest.fixture
def queries(manifest):
    return read_manifest(str(manifest))


def found_at(x_m):
    pose = SE3(rotation=np.eye(3), translation=np.array([x_m, 0.0, 0.0]))
    best = PoseHypothesis(
        T_world_panorama=pose, score=0.9, covariance=np.eye(6), explained_2d=1.0, explained_3d=0.8
    )
    return PanoLocResult(
        status=LocalizationStatus.FOUND,
        reason=None,
        hypotheses=(best,),
        score=0.9,
        margin=1.0,
        arc_count=100,
        rotation_count=24,
        candidate_count=72,
    )


class Places:
    """Locates pictures, but for one that is bad; goes away when it has been asked so often."""

    def __init__(self, patience=99):
        self.asked = []
        self.patience = patience

    async def __call__(self, query):
        if len(self.asked) == self.patience:
            raise UnavailableError("server", "an answer", "none")
        self.asked.append(query.panorama)
        if query.panorama == "b.jpg":
            raise PanoramaError("b.jpg", "a picture", "none")
        return found_at(query.index), "house.rlm", 0.25


def located(queries, path, places):
    """Rows in the order of the queries, after as much work as the places let happen."""
    with Journal(path, ASKED) as journal:
        asyncio.run(locate_all(queries, places, journal, parallel_count=1, progress=ignore))
        return [journal.rows[query.index] for query in queries]


def test_a_manifest_has_paths_and_objects_relative_to_its_folder(queries, tmp_path):
    assert [query.panorama for query in queries] == ["a.jpg", "b.jpg", "c.jpg"]
    assert queries[0].path == tmp_path / "a.jpg"
    assert queries[0].T_prior is None
    np.testing.assert_array_equal(queries[2].T_prior.matrix(), np.eye(4))


@pytest.mark.parametrize(
    "line",
    ["{}", '{"panorama": 7}', '{"panorama": "a", "pose": 1}', "{nonsense",
     '{"panorama": "a", "prior": [[1]]}', '{"panorama": "a", "prior": [[9,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}',
     "# nothing"],
)  # fmt: skip
def test_other_manifests_are_refused(manifest, line):
    manifest.write_text(line)
    with pytest.raises(InputError) as caught:
        read_manifest(str(manifest))
    assert caught.value.reason == "MANIFEST_INVALID"


def test_every_query_has_a_row_and_a_bad_picture_is_its_own_affair(queries, tmp_path):
    rows = located(queries, tmp_path / "journal", Places())
    assert [row["status"] for row in rows] == ["FOUND", "FAILED", "FOUND"]
    assert (rows[1]["reason"], rows[1]["error"]) == (
        "PANORAMA_INVALID",
        "b.jpg: expected a picture, found none",
    )
    assert rows[2]["T_world_panorama"][3] == 2.0
    assert rows[2]["map"] == "house.rlm"


def test_an_interrupted_run_goes_on_with_the_rest(queries, tmp_path):
    path, first, second = tmp_path / "journal", Places(patience=2), Places()
    with pytest.raises(ExceptionGroup) as caught:
        located(queries, path, first)
    assert caught.group_contains(UnavailableError)
    # A line that was being written when the machine went down.
    path.write_bytes(path.read_bytes()[:-4])
    rows = located(queries, path, second)
    assert (first.asked, second.asked) == (["a.jpg", "b.jpg"], ["b.jpg", "c.jpg"])
    assert rows == located(queries, tmp_path / "other", Places())


def test_a_journal_of_other_queries_is_left_alone(queries, tmp_path):
    located(queries, tmp_path / "journal", Places())
    before = (tmp_path / "journal").read_bytes()
    with pytest.raises(InputError, match="a journal of these queries"):
        Journal(tmp_path / "journal", {"maps": []})
    assert (tmp_path / "journal").read_bytes() == before


def test_a_journal_needs_a_place(tmp_path):
    with pytest.raises(InputError, match="a file that can be written, found No such file"):
        Journal(tmp_path / "nowhere" / "journal", ASKED)


def test_the_table_has_a_line_for_each_row(queries, tmp_path):
    rows = located(queries, tmp_path / "journal", Places())
    write_table(rows, tmp_path / "rows.jsonl")
    lines = (tmp_path / "rows.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == rows


def test_the_table_as_parquet_has_the_same_rows(queries, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = located(queries, tmp_path / "journal", Places())
    write_table(rows, tmp_path / "rows.parquet")
    assert parquet.read_table(tmp_path / "rows.parquet").to_pylist() == rows
