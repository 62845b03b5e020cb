from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from roel_client.cli.main import parser
from roel_client.cli.parser import Parser, UsageError, address, between, integer, one_of, size


def usage_error(*arguments: str) -> UsageError:
    with pytest.raises(UsageError) as caught:
        parser().parse_args(arguments)
    return caught.value


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "roel: expected COMMAND, found none"),
        (("map",), "roel map: expected COMMAND, found none"),
        (("map", "build", "--events"), "--events: expected one argument, found none"),
        (
            ("map", "info", "m.rlm", "--frob"),
            "--frob: expected an argument that --help shows, found --frob",
        ),
        (
            ("map", "info"),
            "roel map info: expected MAP.rlm, found none",
        ),
        (
            ("config", "show", "--preset", "best"),
            "--preset: expected one of default, precise, paper, found 'best'",
        ),
        (
            ("map", "export", "m.rlm", "--out", "m.stl"),
            "--out: expected a file name that ends in .npz, .ply, .obj, .json, .csv, .dxf, "
            "found 'm.stl'",
        ),
        (
            ("serve", "--data", "d", "--port", "70000"),
            "--port: expected an integer of at least 0 and at most 65535, found '70000'",
        ),
    ],
)
def test_usage_error_names_subject_expected_and_found(
    arguments: tuple[str, ...], message: str
) -> None:
    assert str(usage_error(*arguments)) == message


def test_unknown_command_lists_the_known_ones() -> None:
    error = usage_error("map", "bild")
    assert error.subject == "roel map"
    for name in ("build", "info", "export"):
        assert name in error.expected


def test_options_are_never_abbreviated() -> None:
    assert "--even" in str(usage_error("map", "build", "--even", "e"))


def test_exclusive_options_are_refused_together() -> None:
    error = usage_error("simulate", "--out", "d", "--seed", "1", "--scene", "cube", "--mesh", "m")
    assert "not allowed with" in error.found


def test_every_message_of_argparse_becomes_one_error() -> None:
    with pytest.raises(UsageError, match=r"^roel: expected a use .*, found something new$"):
        Parser(prog="roel").error("something new")


@pytest.mark.parametrize(
    ("parse", "text", "value"),
    [
        (integer(0), "12", 12),
        (integer(-5), "-5", -5),
        (between(0, 10), "2.5", 2.5),
        (between(0, 10), "10", 10.0),
        (size, "240x180", (240, 180)),
        (address, "localhost:50051", "localhost:50051"),
        (one_of("a", "b"), "b", "b"),
    ],
)
def test_values_are_parsed(parse: object, text: str, value: object) -> None:
    assert callable(parse)
    assert parse(text) == value


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        (integer(0), "-1"),
        (integer(0), "1.0"),
        (integer(0), "1_000"),
        (integer(0), "9" * 30),
        (integer(0, 9), "10"),
        (between(0, 10), "-0.1"),
        (between(0, 10), "inf"),
        (between(0, 10), "nan"),
        (between(0, 10), "ten"),
        (size, "240"),
        (size, "0x180"),
        (size, "240x180x2"),
        (address, "localhost"),
        (address, ":50051x"),
        (address, "host:0"),
        (address, "host:65536"),
    ],
)
def test_values_out_of_range_say_what_was_expected(parse: object, text: str) -> None:
    assert callable(parse)
    with pytest.raises(argparse.ArgumentTypeError, match=r"^expected .*, found '"):
        parse(text)


def leaf_commands() -> list[tuple[str, ...]]:
    """Every command, found by walking the parsers."""

    def walk(node: argparse.ArgumentParser, words: tuple[str, ...]) -> list[tuple[str, ...]]:
        groups = [
            action for action in node._actions if isinstance(action, argparse._SubParsersAction)
        ]
        if not groups:
            return [words]
        return [
            leaf
            for name, child in groups[0].choices.items()
            for leaf in walk(child, (*words, name))
        ]

    return walk(parser(), ())


def test_all_commands_of_the_contract_exist() -> None:
    expected = {"map build", "map info", "map import", "map export", "evaluate map"}
    expected |= {"serve", "simulate", "demo", "health", "bench mapping", "register"}
    expected |= {"refine-poses", "track", "localize", "bench registration", "bench localization"}
    expected |= {"bench poses", "batch localize", "config show"}
    expected |= {"admin fsck", "admin backup", "admin gc"}
    expected |= {"admin token create", "admin token list", "admin token revoke"}
    assert {" ".join(words) for words in leaf_commands()} == expected


@pytest.mark.parametrize("words", leaf_commands(), ids=" ".join)
@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_and_version_work_on_every_command(
    words: tuple[str, ...], option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        parser().parse_args([*words, option])
    assert caught.value.code == 0
    captured = capsys.readouterr()
    assert captured.out.startswith("usage: roel" if option == "--help" else "roel ")
    assert captured.err == ""


def test_building_the_parser_touches_no_file(tmp_path: Path) -> None:
    options = parser().parse_args(["map", "info", str(tmp_path / "missing.rlm")])
    assert options.map == str(tmp_path / "missing.rlm")
