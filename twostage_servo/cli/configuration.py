"""The options by which verbs name a configuration, and how they load it."""

import argparse
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from twostage_servo.cli.output import CommandError, ExitCode, note
from twostage_servo.cli.typed_names import file_path, utf8
from twostage_servo.config.files import find_configuration

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from twostage_servo.config.loader import Config, LoadedConfig
    from twostage_servo.config.machine import Machine


def add_options(parser: argparse.ArgumentParser, *, required: bool) -> None:
    """Declare --config, --set and --json."""
    parser.add_argument(
        "--config",
        type=file_path,
        metavar="FILE",
        required=required,
        help="TOML file, or the name of a shipped one" + ("" if required else " (default: the embedded demo.toml)"),
    )
    parser.add_argument(
        "--set",
        type=utf8,
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="overrides",
        help="override a configuration key by its dotted path, such as simulation.noise_std=0.03; may be repeated; "
        "AXIS:KEY=VALUE for one axis of several",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def load_configuration(options: argparse.Namespace, defaults: "Sequence[str]" = ()) -> "LoadedConfig[Config]":
    """Load what the options name, which is the configuration of one axis; see :func:`load_machine`.

    Raises
    ------
    CommandError
        With every problem of the configuration; or if it is that of a machine of several axes.
    """
    machine = load_machine(options, defaults)
    if machine.is_one_axis:
        return machine.axes[0]
    files = ", ".join(loaded.source for loaded in machine.axes)
    text = f"{machine.source} is a machine of several axes, and this is about one: name {files}"
    raise CommandError(ExitCode.USAGE, "config", text)


def load_machine(options: argparse.Namespace, defaults: "Sequence[str]" = (), file: str | None = None) -> "Machine":
    """Load what the options name: the configuration of an axis, or of a machine of several.

    What is valid and yet to be told, such as a key under a former name, is told on stderr.

    Parameters
    ----------
    options
        With ``config`` and ``overrides``.
    defaults
        Overrides that those of the options override.
    file
        The configuration, where the options do not name it.

    Raises
    ------
    CommandError
        With every problem of the configuration.
    """
    from twostage_servo.config import machine

    with configuration_problems():
        loaded = machine.load_machine(
            find_configuration(options.config if file is None else Path(file)), [*defaults, *options.overrides]
        )
    for one in loaded.notes:
        note(f"note: {one}")
    return loaded


@contextmanager
def configuration_problems() -> "Iterator[None]":
    """Let a configuration error end the verb as bad usage, with every problem in its text and its JSON.

    Raises
    ------
    CommandError
        In place of a :class:`twostage_servo.config.errors.ConfigError`.
    """
    from twostage_servo.config.errors import ConfigError

    try:
        yield
    except ConfigError as error:
        problems = [problem._asdict() for problem in error.problems]
        text = f"the configuration cannot be used\n{error}"
        raise CommandError(ExitCode.USAGE, "config", text, {"problems": problems}) from error
