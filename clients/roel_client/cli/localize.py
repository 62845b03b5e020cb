"""`roel localize`."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import Any

from roel_client.cli.configuration import effective_config
from roel_client.cli.output import print_result
from roel_client.cli.parser import Command, Subparsers, UsageError, command, one_of
from roel_client.cli.process import interruptible
from roel_client.cli.servers import add_server_options, server_options
from roel_client.cli.staging import Staged
from roel_service.errors import NoAnswerError

FOUND = "FOUND"

# Presets, and what each locates by.
DEFAULT = "default"
METHODS = {
    "default": DEFAULT,
    "paper": "fgpl",
    "fgpl": "fgpl",
    "fgpl-released": "fgpl-released",
}


def add_commands(subparsers: Subparsers) -> None:
    """Declare `localize`."""
    what = Command(
        run=localize,
        inputs=("map", "more_maps", "panoramas", "prior", "camera", "config"),
        folders=("overlay",),
    )
    parser = command(subparsers, "localize", "find where panoramas were taken in a map", what)
    parser.add_argument("map", metavar="MAP", help=".rlm file or exported .npz")
    parser.add_argument(
        "panoramas",
        metavar="PANO",
        nargs="+",
        help="equirectangular JPEG or PNG, width twice the height",
    )
    parser.add_argument(
        "--map",
        action="append",
        default=[],
        dest="more_maps",
        metavar="MAP",
        help="another map that may hold the place, up to seven times",
    )
    parser.add_argument(
        "--prior", metavar="T.txt", help="first T_world_panorama, within 1 m, 30 deg"
    )
    parser.add_argument(
        "--camera",
        metavar="FILE.json",
        help="the camera of ordinary photographs, in place of panoramas; needs --prior",
    )
    parser.add_argument(
        "--preset",
        default="default",
        type=one_of(*METHODS),
        metavar="NAME",
        help="default, or fgpl: FGPL as published, which is paper, too; or fgpl-released",
    )
    parser.add_argument("--config", metavar="FILE.toml", help="parameters that differ")
    parser.add_argument("--overlay", metavar="DIR", help="pictures with the map's lines over them")
    parser.add_argument("--strict", action="store_true", help="end with 3 unless all are FOUND")
    parser.add_argument("--json", action="store_true", help="print as JSON, one line a panorama")
    add_server_options(parser, required=False, what="let this server locate the panoramas")


def localize(options: argparse.Namespace, staged: Staged) -> None:
    """Locate panoramas, and print where each was taken as soon as it is known."""
    from roel_client.local import localization

    method = METHODS[options.preset]
    if options.camera is not None:
        require_for_photographs(options)
    for name in ("prior", "server"):
        if method != DEFAULT and getattr(options, name) is not None:
            raise UsageError("--preset", f"default, as there is --{name}", options.preset)
    parameters = argparse.Namespace(preset=DEFAULT, config=options.config)
    maps = [options.map, *options.more_maps]
    asked: dict[str, Any] = {
        "prior": options.prior,
        "config": effective_config(parameters).localize,
        "overlay": staged.get("overlay"),
    }
    if options.server is None:
        documents = localization.localize_panoramas(
            maps, options.panoramas, method=method, camera=options.camera, **asked
        )
        report(documents, options)
        return
    server = {"server": options.server, "options": server_options(options)}
    # A signal must reach the client, which then takes what it hosted away.
    with interruptible():
        report(
            localization.localize_panoramas_remotely(maps, options.panoramas, **asked, **server),
            options,
        )


def require_for_photographs(options: argparse.Namespace) -> None:
    """Raise `UsageError` unless the options are those that photographs can be located with."""
    if options.prior is None:
        raise UsageError("--camera", "a first pose beside it (--prior)", "none")
    for name in ("overlay", "server"):
        if getattr(options, name) is not None:
            raise UsageError(f"--{name}", "panoramas, not photographs (--camera)", "photographs")


def report(documents: Iterable[dict[str, Any]], options: argparse.Namespace) -> None:
    """Print each document as it comes; with --strict raise `NoAnswerError` unless all are FOUND."""
    if options.strict and not options.json:
        # Without an answer for all, nothing goes to stdout.
        documents = list(documents)
        require_found(documents)
    lost = []
    for document in documents:
        print_result(document, told(document), as_json=options.json)
        lost += [] if document["status"] == FOUND else [document]
    if options.strict:
        require_found(lost)


def require_found(documents: Iterable[dict[str, Any]]) -> None:
    """Raise `NoAnswerError` about the first panorama without a pose to rely on."""
    for document in documents:
        if document["status"] != FOUND:
            raise NoAnswerError(
                document["panorama"], "a pose to rely on", document["reason"], reason="NOT_LOCATED"
            )


def told(document: dict[str, Any]) -> str:
    """The pose for people."""
    reason = "" if document["reason"] is None else f" ({document['reason']})"
    place = f" in {document['map']}" if document.get("map") else ""
    score = f"score {document['score']:.2f}"
    head = f"{document['panorama']}: {document['status']}{reason}{place}, {score}"
    rows = [
        " ".join(f"{value:12.9f}" for value in row) for row in document["T_world_panorama"] or []
    ]
    return "\n".join([head, *rows])
