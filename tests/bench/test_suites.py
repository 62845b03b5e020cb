import itertools

import pytest

from roel_bench.catalogue import REPORTING_ROOMS, TUNING_ROOMS, TUNING_SEEDS
from roel_bench.methods import PEERS, find_method
from roel_bench.suites import FRONT_END, MAP, SUITES, Cell, select
from roel_bench.variants import VARIANTS, find_variant
from roel_service.config.presets import PRESETS
from roel_service.errors import ConfigError, InputError


def test_full_holds_every_other_suite_but_the_smoke_run():
    full = set(select("full"))
    for name in SUITES.keys() - {"full", "quick"}:
        assert full >= set(select(name)), name


def test_cells_come_once_and_scene_by_scene():
    cells = select("full")
    assert len(cells) == len(set(cells))
    scenes = [cell.scene for cell in cells]
    changes = sum(a != b for a, b in itertools.pairwise(scenes))
    assert changes == len(set(scenes)) - 1


def test_tuning_rooms_are_not_among_those_reported():
    assert not set(TUNING_ROOMS) & set(REPORTING_ROOMS)
    assert not any(f"sim_{seed}_" in room for seed in TUNING_SEEDS for room in REPORTING_ROOMS)


def test_scenes_and_methods_are_chosen():
    cells = select("noise", scenes=("sim_211_346x260_6s",))
    assert {cell.scene for cell in cells} == {"sim_211_346x260_6s"}
    cells = select("full", scenes=("room_12",), methods=("paper",))
    assert cells == [Cell(task=MAP, scene="room_12", method="paper")]


def test_a_new_scene_gets_what_the_others_get():
    cells = select("presets", scenes=("folder:x",), methods=("default",))
    assert {(cell.task, cell.scene) for cell in cells} == {
        (MAP, "folder:x"),
        (FRONT_END, "folder:x"),
    }


def test_a_new_method_makes_maps_of_the_suites_scenes():
    cells = select("quick", methods=("EMVS",))
    assert cells == [Cell(task=MAP, scene="sim_1_173x130_1s", method="EMVS")]


def test_unknown_names_are_refused():
    with pytest.raises(InputError, match="one of quick"):
        select("nope")
    with pytest.raises(ConfigError, match="'nope'"):
        find_method("nope")
    with pytest.raises(ConfigError, match="nope"):
        find_variant("nope")


def test_every_preset_is_a_variant_and_every_variant_a_configuration():
    assert PRESETS.keys() <= VARIANTS.keys()
    digests = {name: find_method(name).digest for name in VARIANTS}
    # No two rows of a table are the same run under two names.
    assert len(set(digests.values())) == len(digests)


def test_all_methods_of_the_suites_exist():
    methods = {cell.method for cell in select("full")}
    assert methods <= VARIANTS.keys() | PEERS.keys()
