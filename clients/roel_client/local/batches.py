"""Many panoramas are located, in children of this process or on a server."""

from __future__ import annotations

import asyncio
import dataclasses
import hashlib
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roel_client.local.localization import MAX_INLINE_BYTES
from roel_client.local.maps import digest_of
from roel_service.wire.names import is_resource_name

if TYPE_CHECKING:
    from roel_client.batch import Locate, Located, Query
    from roel_service.config.stages import LocalizeConfig
    from roel_service.progress import ProgressCallback
    from roel_service.scene.results import PanoLocResult


def localize_batch(
    manifest: str,
    names: list[str],
    out: str,
    *,
    config: LocalizeConfig,
    worker_count: int | None,
    server: tuple[str, dict[str, Any]] | None,
    progress: ProgressCallback,
) -> dict[str, Any]:
    """Locate the panoramas of a manifest and write a row for each; what `roel batch` prints.

    Args:
        names: of maps: files or, with a server, versions that it has.
        out: the table; beside it lies the journal of a run that was interrupted.
        worker_count: queries at a time; None takes one a core.
        server: its address, and arguments of `Client` beside it; None works in this process.
    """
    from roel_client import batch

    if out.endswith(".parquet"):
        batch.require_parquet(out)
    queries = batch.read_manifest(manifest)
    parallel_count = worker_count or batch.default_worker_count()
    asked = {
        "manifest": hashlib.sha256(Path(manifest).read_bytes()).hexdigest(),
        "maps": [name if is_resource_name(name) else digest_of(name) for name in names],
        "config": dataclasses.asdict(config),
    }
    with batch.Journal(Path(f"{out}.partial"), asked) as journal:
        known_count = len(journal.rows)

        async def run() -> None:
            locating = (
                _locating_here(names, config, parallel_count)
                if server is None
                else _locating_there(names, config, *server)
            )
            async with locating as locate:
                await batch.locate_all(
                    queries, locate, journal, parallel_count=parallel_count, progress=progress
                )

        with _first_error():
            asyncio.run(run())
        rows = [journal.rows[query.index] for query in queries]
        batch.write_table(rows, Path(out))
        journal.delete()
    statuses = [row["status"] for row in rows]
    return {
        "query_count": len(rows),
        "found_count": statuses.count("FOUND"),
        "ambiguous_count": statuses.count("AMBIGUOUS"),
        "not_found_count": statuses.count("NOT_FOUND"),
        "failed_count": statuses.count(batch.FAILED),
        "known_count": known_count,
    }


@contextmanager
def _first_error() -> Iterator[None]:
    """Of tasks that failed together, the first one speaks."""
    try:
        yield
    except ExceptionGroup as group:
        raise group.exceptions[0] from None


@asynccontextmanager
async def _locating_here(
    names: list[str], config: LocalizeConfig, worker_count: int
) -> AsyncIterator[Locate]:
    """Locates in children of this process, which stay and keep the prepared maps."""
    from roel_service.jobs.questions import LocalizeQuestion, MapFile
    from roel_service.jobs.task import Limits, TaskSpec
    from roel_service.jobs.warm import WarmExecutor
    from roel_service.pano_loc.hints import PosePrior
    from roel_service.v1 import localization_pb2
    from roel_service.wire.localization import localization_from_proto

    entrypoint = "roel_service.jobs.desk:Desk"
    executor = WarmExecutor(worker_count, worker_count, preload=entrypoint)
    maps = tuple(
        MapFile(name=name, path=Path(name).resolve(), sha256=digest_of(name)) for name in names
    )

    async def locate(query: Query) -> Located:
        prior = None if query.T_prior is None else PosePrior(T_world_picture=query.T_prior)
        question = LocalizeQuestion(
            maps=maps,
            image=await asyncio.to_thread(_picture_bytes, query),
            prior=prior,
            camera=None,
            gravity=None,
            max_hypothesis_count=config.max_hypothesis_count,
            config=config,
            cache=None,
        )
        spec = TaskSpec(entrypoint=entrypoint, parameters=question, limits=Limits())
        answer = await executor.run(spec, _ignore_news)
        message = localization_pb2.LocalizeResponse.FromString(answer)
        return _located(localization_from_proto(message), names, message.seconds)

    try:
        yield locate
    finally:
        await executor.close()


@asynccontextmanager
async def _locating_there(
    names: list[str], config: LocalizeConfig, server: str, options: dict[str, Any]
) -> AsyncIterator[Locate]:
    """Locates on a server, which keeps the prepared maps."""
    from roel_client.aio import AsyncClient
    from roel_service.wire.localization import localization_from_proto

    async with AsyncClient(server, **options) as client, AsyncExitStack() as hosting:
        versions = [
            name
            if is_resource_name(name)
            else await hosting.enter_async_context(client.hosted_map(Path(name)))
            for name in names
        ]

        async def locate(query: Query) -> Located:
            image = await asyncio.to_thread(_picture_bytes, query)
            sent = image if len(image) <= MAX_INLINE_BYTES else await client.upload_blob(query.path)
            message = await client.localize(versions, sent, T_prior=query.T_prior, config=config)
            return _located(localization_from_proto(message), names, message.seconds)

        yield locate


def _picture_bytes(query: Query) -> bytes:
    from roel_service.io.files import read_input
    from roel_service.io.images import MAX_FILE_BYTES

    return read_input(query.path, MAX_FILE_BYTES)


def _located(result: PanoLocResult, names: list[str], seconds: float) -> Located:
    best = names[result.hypotheses[0].map_index] if result.hypotheses else None
    return result, best, seconds


async def _ignore_news(news: object) -> None:
    """Nobody watches a single query."""
