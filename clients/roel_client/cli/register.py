"""`roel register`."""

from __future__ import annotations

import argparse
from typing import Any

from roel_client.cli.configuration import effective_config
from roel_client.cli.output import print_result
from roel_client.cli.parser import Command, Subparsers, UsageError, command, one_of, suffixed
from roel_client.cli.process import interruptible
from roel_client.cli.servers import add_server_options, server_options
from roel_client.cli.staging import Staged
from roel_service.errors import NoAnswerError

METHODS = ("auto", "point", "plane", "line", "global")
ACCEPTED = "ACCEPTED"


def add_commands(subparsers: Subparsers) -> None:
    """Declare `register`."""
    what = Command(run=register, inputs=("map", "cloud", "init", "config"), outputs=("plot",))
    parser = command(subparsers, "register", "find where a map lies in a point cloud", what)
    parser.add_argument("map", metavar="MAP", help=".rlm file or exported .npz; the source")
    parser.add_argument(
        "cloud", metavar="CLOUD", help="PLY, PCD, LAS, LAZ, VTK, NPZ, text or a mesh; the target"
    )
    parser.add_argument("--init", metavar="T.txt", help="first T_target_source; default: identity")
    parser.add_argument(
        "--method",
        default="auto",
        type=one_of(*METHODS),
        metavar="NAME",
        help=f"one of {', '.join(METHODS)}; default: auto",
    )
    parser.add_argument("--config", metavar="FILE.toml", help="parameters that differ")
    parser.add_argument(
        "--plot", type=suffixed(".png"), metavar="FILE.png", help="map and cloud, before and after"
    )
    parser.add_argument(
        "--strict", action="store_true", help="end with 3 unless the verdict is ACCEPTED"
    )
    parser.add_argument("--json", action="store_true", help="print as JSON")
    add_server_options(parser, required=False, what="let this server register the map")
    parser.set_defaults(preset="default")


def register(options: argparse.Namespace, staged: Staged) -> None:
    """Register a map, and print where it lies."""
    from roel_client.local import registration

    if options.method == "global" and options.init is not None:
        raise UsageError("--init", "no first guess with --method global", options.init)
    asked: dict[str, Any] = {
        "init": options.init,
        "method": options.method,
        "config": effective_config(options).register,
        "plot": staged.get("plot"),
    }
    if options.server is None:
        found = registration.register_map(options.map, options.cloud, **asked)
    else:
        server = {"server": options.server, "options": server_options(options)}
        # A signal must reach the client, which then takes what it hosted away.
        with interruptible():
            found = registration.register_map_remotely(
                options.map, options.cloud, **asked, **server
            )
    if options.strict and found["verdict"] != ACCEPTED:
        raise NoAnswerError(
            options.map,
            "a registration to rely on",
            f"{found['verdict']}, fitness {found['fitness']:.2f}",
            reason="NOT_REGISTERED",
            result=found,
        )
    print_result(found, told(found), as_json=options.json)


def told(found: dict[str, Any]) -> str:
    """The transform for people."""
    rmse_m = found["inlier_rmse_m"]
    rmse = "" if rmse_m is None else f", rms {1e3 * rmse_m:.1f} mm"
    rows = "\n".join(
        " ".join(f"{value:12.9f}" for value in row) for row in found["T_target_source"]
    )
    return f"{found['verdict']}: fitness {found['fitness']:.2f}{rmse}\n{rows}"
