"""Which control socket a configuration names; for the commands to a running service, which need nothing else of it."""

from pathlib import Path

from twostage_servo.config.errors import ConfigError
from twostage_servo.config.toml_file import read_toml


def socket_named_in(path: Path) -> Path | None:
    """Return the control socket that the file of an axis or of a machine names, None if it names none.

    Raises
    ------
    ConfigError
        The file cannot be read, is not TOML, or what it names is not a text. Nothing else in it is judged.
    """
    file = read_toml(path)
    service = file.data.get("service", {})
    named = service.get("socket", "") if isinstance(service, dict) else service
    if not isinstance(named, str) or not isinstance(service, dict):
        from twostage_servo.config.document import Document  # noqa: PLC0415 - the commands start without it

        key = ("service", "socket") if isinstance(service, dict) else ("service",)
        needed = "a text in quotes is needed" if isinstance(service, dict) else "a table is needed"
        raise ConfigError([Document(file.source, file.data, file.lines).problem(key, needed)])
    return Path(named) if named else None
