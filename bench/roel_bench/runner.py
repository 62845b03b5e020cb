"""Run the cells of a suite one after the other and keep a row of each.

Rows are written as soon as they are known, so that an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from roel_bench import memory
from roel_bench.catalogue import WARM_UP_ROOM, Places, find_scene, open_scene
from roel_bench.disturbances import DISTURBANCES
from roel_bench.front_end import (
    FRAME_STRIDE,
    FrameLines,
    FrameTruth,
    lines_of_frames,
    run_front_end,
)
from roel_bench.methods import Method, find_method
from roel_bench.pictures import draw_frames, draw_map
from roel_bench.results import (
    FILE_NAME,
    NO_DISTURBANCE,
    Results,
    Row,
    read_results,
    this_machine,
    write_results,
)
from roel_bench.scenes import MapTruth, Scene
from roel_bench.scores import score
from roel_bench.suites import DRAWN_METHODS, FRONT_END, PRESET_NAMES, Cell, current_digest
from roel_bench.variants import find_variant
from roel_service.errors import InputError, NoAnswerError, NotFoundError
from roel_service.progress import Progress, ProgressCallback, ignore

logger = logging.getLogger(__name__)

# Chance of disturbances.
SEED = 0
# Frames of a picture of a recording without poses.
PICTURE_FRAME_COUNT = 3


@dataclass(frozen=True, kw_only=True)
class Runner:
    """What the cells of one run share.

    Attributes:
        places: where scenes are found.
        folder: holds `mapping.json` and `pictures`; made if need be.
        progress: called often; may raise `Cancelled`.
    """

    places: Places
    folder: Path
    progress: ProgressCallback = ignore
    _warm: set[str] = field(default_factory=set)

    def run(self, cells: Iterable[Cell]) -> Results:
        """Run the cells that the folder has no row of yet, or one of an error or other parameters.

        Raises:
            InputError: an unknown scene; a folder that cannot be written, or that holds results
                of another machine; a scene that cannot be opened.
            ConfigError: an unknown method.
        """
        cells = list(cells)
        openers = {name: find_scene(name, self.places) for name in {c.scene for c in cells}}
        digests = [current_digest(cell.task, cell.method) for cell in cells]
        results = self._results()
        scene: Scene | None = None
        truths = _FrameTruths()
        for index, (cell, digest) in enumerate(zip(cells, digests, strict=True)):
            known = {row.key: row.config_digest for row in results.rows if not row.error}
            if known.get(cell.key) == digest:
                continue
            step = self._step(cell, index, len(cells))
            if scene is None or scene.name != cell.scene:
                scene = openers[cell.scene](step)
            try:
                row = self._row(cell, scene, truths, step)
            except NotFoundError as error:
                logger.warning("left out: %s", error)  # a peer that is not installed
                continue
            results = results.with_row(row)
            write_results(self.folder / FILE_NAME, results)
            told = row.error or row.figures
            logger.info("%s %s %s: %s", cell.task, cell.scene, cell.method, told)
        return results

    def _results(self) -> Results:
        """The rows that are there already; pictures of the same folder are theirs."""
        try:
            (self.folder / "pictures").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            found = error.strerror or str(error)
            raise InputError(str(self.folder), "a folder to write to", found) from error
        path = self.folder / FILE_NAME
        here = this_machine()
        if not path.exists():
            return here
        there = read_results(path)
        if (there.machine, there.versions) != (here.machine, here.versions):
            raise InputError(str(path), "results of this machine and these versions", "others")
        return there

    def _step(self, cell: Cell, index: int, count: int) -> ProgressCallback:
        """Progress of one cell as a part of all."""

        def step(inner: Progress) -> None:
            self.progress(
                Progress(
                    stage=f"{cell.scene} {cell.method}",
                    done_count=index,
                    total_count=count,
                    fraction=(index + inner.fraction) / count,
                )
            )

        return step

    def _row(self, cell: Cell, scene: Scene, truths: _FrameTruths, step: ProgressCallback) -> Row:
        disturbed = scene
        if cell.disturbance != NO_DISTURBANCE:
            disturbed = DISTURBANCES[cell.disturbance](scene, SEED)
        if cell.task == FRONT_END:
            return self._front_end_row(cell, disturbed, truths.of(disturbed), step)
        return self._map_row(cell, disturbed, step)

    def _map_row(self, cell: Cell, scene: Scene, step: ProgressCallback) -> Row:
        self._warm_up(cell)
        method = find_method(cell.method)
        memory.reset_peak()
        began_s = time.process_time()
        try:
            mapped = method.run(scene, step)
        except NoAnswerError as error:
            return _failed(cell, scene, method, error)
        processor_s = time.process_time() - began_s
        peak_rss_mib = memory.peak_mib()
        figures = score(scene, mapped.entities)
        if cell.disturbance == NO_DISTURBANCE and cell.method in DRAWN_METHODS:
            title = f"{cell.method} on {cell.scene}: {len(mapped.entities)} entities"
            draw_map(scene, mapped.entities, title, self._picture(cell))
        return Row(
            task=cell.task,
            scene=scene.name,
            sensor=scene.sensor,
            is_tuning=scene.is_tuning,
            disturbance=cell.disturbance,
            method=method.name,
            config_digest=method.digest,
            figures=figures,
            seconds=mapped.seconds,
            frame_count=mapped.frame_count,
            event_count=mapped.event_count,
            peak_rss_mib=peak_rss_mib,
            # A method without frames, LIMAP above all, may work in a process of its own.
            processor_s=processor_s if mapped.frame_count else None,
        )

    def _front_end_row(
        self, cell: Cell, scene: Scene, truth: FrameTruth | None, step: ProgressCallback
    ) -> Row:
        self._warm_up(cell)
        config = find_variant(cell.method).config

        def frame_done(done_count: int, total_count: int) -> None:
            step(Progress(stage=FRONT_END, done_count=done_count, total_count=0, fraction=0.0))

        memory.reset_peak()
        scores = run_front_end(scene, config, truth, frame_done, FRAME_STRIDE)
        peak_rss_mib = memory.peak_mib()
        if cell.method in PRESET_NAMES:
            found = list(lines_of_frames(scene, config, FRAME_STRIDE))
            title = f"{cell.method} on {cell.scene}"
            draw_frames(_spread(found), title, self._picture(cell))
        return Row(
            task=cell.task,
            scene=scene.name,
            sensor=scene.sensor,
            is_tuning=scene.is_tuning,
            disturbance=cell.disturbance,
            method=cell.method,
            config_digest=current_digest(cell.task, cell.method),
            figures=scores.figures(),
            seconds=scores.seconds,
            frame_count=scores.frame_count,
            event_count=scores.event_count,
            peak_rss_mib=peak_rss_mib,
        )

    def _picture(self, cell: Cell) -> Path:
        name = re.sub(r"[^\w.-]+", "_", f"{cell.task}_{cell.scene}_{cell.method}")
        return self.folder / "pictures" / f"{name}.png"

    def _warm_up(self, cell: Cell) -> None:
        """Run a method once on a tiny room, so that no compilation is timed."""
        if cell.method in self._warm:
            return
        self._warm.add(cell.method)
        room = open_scene(WARM_UP_ROOM, self.places, ignore)
        # The longest windows are longer than the room, and a peer may find nothing in it.
        with suppress(NoAnswerError):
            if cell.task != FRONT_END:
                find_method(cell.method).run(room, ignore)
                return
            config = find_variant(cell.method).config
            run_front_end(room, config, None, lambda done, total: None, FRAME_STRIDE)


class _FrameTruths:
    """The last scene's truth of frames: variants of one scene ask for the same frames."""

    def __init__(self) -> None:
        self._scene: Scene | None = None
        self._truth: FrameTruth | None = None

    def of(self, scene: Scene) -> FrameTruth | None:
        """None where the edges of a scene or its poses are not known."""
        if scene is not self._scene:
            self._scene, self._truth = scene, None
            truth, poses = scene.truth, scene.trajectory
            if isinstance(truth, MapTruth) and truth.edges is not None and poses is not None:
                self._truth = FrameTruth(scene, truth, poses)
        return self._truth


def _failed(cell: Cell, scene: Scene, method: Method, error: NoAnswerError) -> Row:
    """The row of a method that made no map."""
    logger.warning("%s on %s: %s", method.name, scene.name, error)
    return Row(
        task=cell.task,
        scene=scene.name,
        sensor=scene.sensor,
        is_tuning=scene.is_tuning,
        disturbance=cell.disturbance,
        method=method.name,
        config_digest=method.digest,
        figures={},
        seconds={},
        frame_count=0,
        event_count=0,
        peak_rss_mib=None,
        error=f"{error.reason}: {error.found}",
    )


def _spread(frames: list[FrameLines]) -> list[FrameLines]:
    """Some frames, evenly over a recording."""
    step = max(1, len(frames) // PICTURE_FRAME_COUNT)
    return frames[step // 2 :: step][:PICTURE_FRAME_COUNT]
