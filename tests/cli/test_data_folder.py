import json

import pytest

from roel_client.cli.main import main
from roel_client.local import data_folder
from roel_service.errors import NoAnswerError
from roel_service.store import schema
from roel_service.store.store import Store


@pytest.fixture
def folder(tmp_path):
    with Store(tmp_path / "data") as store:
        store.maps.create("house")
    return tmp_path / "data"


def test_a_sound_folder_is_told_so(folder, capfd):
    assert main(["admin", "fsck", "--data", str(folder), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["problems"] == []


def test_problems_are_an_answer_of_their_own(folder, capfd):
    lost = {column.name: column.type.python_type() for column in schema.OPERATION.columns}
    lost |= {"id": "o", "method": "BuildMap", "map_id": "house", "version": 1, "state": "queued"}
    with Store(folder) as store, store._database.write() as connection:
        connection.execute(schema.OPERATION.insert().values(lost))
    assert main(["admin", "fsck", "--data", str(folder), "--json"]) == 3
    printed = capfd.readouterr()
    assert json.loads(printed.out)["problems"]
    assert printed.err.startswith("roel: no answer: ")
    with pytest.raises(NoAnswerError) as caught:
        data_folder.check_data(str(folder))
    assert caught.value.reason == "DATA_UNSOUND"


def test_a_backup_is_a_folder_of_its_own(folder, tmp_path, capfd):
    copy = tmp_path / "copy"
    assert main(["admin", "backup", "--data", str(folder), "--out", str(copy), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["map_version_count"] == 0
    with Store(copy) as store:
        assert store.maps.get("house").id == "house"
    assert main(["admin", "backup", "--data", str(folder), "--out", str(copy)]) == 2


def test_garbage_goes_unless_a_server_has_the_folder(folder, capfd):
    assert main(["admin", "gc", "--data", str(folder), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["deleted_blob_count"] == 0
    with Store(folder):
        assert main(["admin", "gc", "--data", str(folder)]) == 2
    assert "one in use" in capfd.readouterr().err


@pytest.mark.parametrize("command", [["fsck"], ["gc"], ["backup", "--out", "copy"]])
def test_a_folder_that_is_none_is_told_in_one_line(command, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["admin", *command, "--data", "nowhere"]) == 2
    assert capfd.readouterr().err == "roel: error: nowhere: expected a data folder, found none\n"
