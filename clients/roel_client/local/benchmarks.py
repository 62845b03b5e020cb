"""The benchmarks."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roel_client.local.maps import read_map
from roel_client.local.registration import read_target

if TYPE_CHECKING:
    from roel_service.progress import ProgressCallback


def bench_mapping(
    out: Path,
    *,
    suite: str,
    scenes: tuple[str, ...] | None,
    methods: tuple[str, ...] | None,
    data: Path | None,
    rooms: Path,
    progress: ProgressCallback,
) -> tuple[dict[str, Any], str]:
    """Run a suite of the benchmark in a folder; all its rows, as a document and as Markdown."""
    from roel_bench import suites, tables
    from roel_bench.catalogue import Places
    from roel_bench.results import to_document
    from roel_bench.runner import Runner

    cells = suites.select(suite, scenes, methods)
    results = Runner(places=Places(data=data, rooms=rooms), folder=out, progress=progress).run(
        cells
    )
    text = tables.all_rows(results)
    tables.write_text(out / "mapping.md", text)
    return to_document(results), text


def bench_registration(
    path: Path,
    *,
    rooms: list[tuple[str, str]],
    has_large: bool,
    symmetric_count: int,
    scans: Path | None,
    max_count: int | None,
    progress: ProgressCallback,
) -> tuple[dict[str, Any], str]:
    """Run what the file does not hold of the registration benchmark; its trials, and their page.

    Args:
        path: JSON file, which an interrupted run goes on with.
        rooms: pairs of map and cloud, or of two maps.
        has_large: whether all rooms side by side are a place as well.
        symmetric_count: rooms of boxes to make.
        scans: folder of real scans.
        max_count: trials of each kind at the most.
    """
    from dataclasses import replace

    from roel_bench import (
        registration,
        registration_places,
        registration_report,
        registration_scans,
    )

    places = [
        registration_places.place_of(
            Path(map_name).stem, read_map(map_name), Path(target).stem, read_target(target)
        )
        for map_name, target in rooms
    ]
    if has_large:
        places.append(registration_places.side_by_side(places))
    places += registration_places.symmetric_rooms(symmetric_count)
    protocols = [
        replace(protocol, count=min(protocol.count, max_count or protocol.count))
        for protocol in registration.PROTOCOLS
    ]
    if scans is not None:
        registration.keep(registration_scans.run(scans), path)
    document = registration.run(places, protocols, progress, path=path)
    return document, registration_report.document(document)


def bench_poses(
    path: Path,
    *,
    rooms: tuple[str, ...],
    seed_count: int,
    data: Path | None,
    kept: Path,
    progress: ProgressCallback,
) -> tuple[dict[str, Any], str]:
    """Run what the file does not hold of the benchmark of poses; all rows, and their page."""
    from roel_bench import poses, poses_report
    from roel_bench.catalogue import Places

    results = poses.run(path, rooms, seed_count, Places(data=data, rooms=kept), progress)
    return asdict(results), poses_report.document(results)


def bench_localization(
    path: Path,
    *,
    rooms: list[tuple[str, str]],
    house: tuple[str, str] | None,
    symmetric_count: int,
    protocols: list[str],
    methods: list[str],
    max_count: int | None,
    again: bool,
    progress: ProgressCallback,
) -> tuple[dict[str, Any], str]:
    """Run what the file does not hold of the localization benchmark; the file, and its tables.

    Args:
        path: JSON file, which an interrupted run goes on with.
        rooms: pairs of map and folder of panoramas.
        house: archive of lines with rooms, and folder of photographs.
        symmetric_count: rooms of boxes to make.
        protocols, methods: names; all without any.
        max_count: panoramas of a place at the most.
        again: run what the file holds, too.
    """
    from dataclasses import replace

    from roel_bench import localization, localization_places, localization_report

    places = [
        localization_places.room(Path(name).stem, read_map(name), Path(folder))
        for name, folder in rooms
    ]
    if house is not None:
        places += localization_places.house(Path(house[0]), Path(house[1]))
    places += localization_places.symmetric_rooms(symmetric_count)
    chosen = [
        replace(protocol, max_count=min(protocol.max_count, max_count or protocol.max_count))
        for protocol in localization.PROTOCOLS
        if not protocols or protocol.name in protocols
    ]
    results = localization.run(
        places, chosen, localization.find_methods(methods), path, progress, again=again
    )
    return localization.to_document(results), localization_report.measured(results)
