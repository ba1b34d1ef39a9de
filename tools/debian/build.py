"""Build the Debian package: `python3 -m tools.debian.build --output FOLDER`.

The package needs nothing from a network where it is installed: /opt/twostage-servo is a virtual environment with all
that the service imports. It is for the processor and the Python of the machine that it is built on, Debian 12 or newer;
dpkg-deb and python3-venv have to be there, and nobody needs to be root. The maintainer's scripts lie beside this file.
"""

import argparse
import gzip
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import Any, Final

from tools.debian.control_files import NAME, control_text, copyright_text, oldest_libc

HERE: Final = Path(__file__).resolve().parent
TREE: Final = HERE.parents[1]
SCRIPTS: Final = ("preinst", "postinst", "prerm", "postrm")
EXAMPLES: Final = (
    "socketcan.toml", "two_processes.toml", "two_axes.toml", "second_axis.toml", "rotary_table.toml", "metres.toml",
    "free_running.toml", "fast_tick.toml", "plain_drive.toml", "servo_drive.dbc", "rotary_table.dbc",
    "plain_drive.dbc",
)  # fmt: skip
_OPT: Final = Path("opt") / NAME
_DOC: Final = Path("usr/share/doc") / NAME
_PYTHON: Final = "/usr/bin/python3"
_SOURCES: Final = ("twostage_servo", "config", "systemd")
_TOP_FILES: Final = ("pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md")
_EXTRAS: Final = ("paper", "multicast")
"""What verbs may need: nobody installs it later on a machine without a network."""


class BuildError(Exception):
    """The package cannot be built; the text says why, and what to do."""


def version(date: int) -> str:
    """Return the package's version: the tree's, and the date of its newest source, s since 1970.

    So apt can tell one build between two releases from another, and which of them is the newer one.
    """
    found: str = tomllib.loads((TREE / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    return f"{found}+{datetime.fromtimestamp(date, UTC):%Y%m%d%H%M%S}"


class Stage:
    """The files of the package, below a folder.

    Parameters
    ----------
    root
        The folder; what lies in it is what will lie below ``/``.
    date
        Of the build, s since 1970: of everything that has to carry a date.
    """

    def __init__(self, root: Path, date: int) -> None:
        self.root = root
        self._opt = root / _OPT
        self._date = date
        self.packages: list[Distribution] = []
        self.python = (0, 0)

    def build(self, work: Path, wheels: Path | None) -> None:
        """Put everything there.

        Parameters
        ----------
        work
            Folder for what the build needs and the package does not.
        wheels
            Folder with all wheels; None for the index that pip is configured for.
        """
        self._make_environment(work, wheels)
        self._place_services()
        self._place_documents()
        self._try_out()
        self._tidy()

    def _make_environment(self, work: Path, wheels: Path | None) -> None:
        self._opt.parent.mkdir(parents=True)
        _run(_PYTHON, "-m", "venv", "--without-pip", str(self._opt))
        python = str(self._opt / "bin/python3")
        shown = _run(python, "-c", "import sys; print(*sys.version_info[:2])").split()
        self.python = (int(shown[0]), int(shown[1]))
        _run(_PYTHON, "-m", "venv", str(work / "builder"))
        source = work / "source"
        source.mkdir()
        for name in _SOURCES:
            shutil.copytree(TREE / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        for name in _TOP_FILES:
            shutil.copy(TREE / name, source)
        pip = (str(work / "builder/bin/python"), "-m", "pip", "--quiet", "--disable-pip-version-check", "--no-input")
        where = () if wheels is None else ("--no-index", "--find-links", str(wheels.resolve()))
        try:
            _run(*pip, "wheel", *where, "--no-deps", "--wheel-dir", str(work), str(source))
            (own,) = work.glob("twostage_servo-*.whl")
            install = ("install", *where, "--only-binary=:all:", "--no-compile", "--no-warn-script-location")
            own_with_extras = f"{own}[{','.join(_EXTRAS)}]"
            _run(*pip, "--python", python, *install, own_with_extras)
        except BuildError as error:
            if wheels is None:
                raise
            pip_of = f"{_PYTHON} -m venv /tmp/filling && /tmp/filling/bin/pip"
            fill = f"{pip_of} wheel --wheel-dir {wheels} '{TREE}[{','.join(_EXTRAS)}]' 'setuptools>=77'"
            text = f"{error}\nIf a wheel is missing in {wheels}, fill it where there is a network:\n  {fill}"
            raise BuildError(text) from error
        self.packages = sorted(distributions(path=[str(self._site())]), key=lambda one: one.name.lower())

    def _site(self) -> Path:
        return self._opt / f"lib/python{self.python[0]}.{self.python[1]}/site-packages"

    def _place_services(self) -> None:
        program = f"/{_OPT}/bin/{NAME}"
        self._program("install-service", "--vendor", "--root", str(self.root), "--program", program)
        (self.root / "etc" / NAME).mkdir(parents=True)
        link = self.root / "usr/bin" / NAME
        link.parent.mkdir(parents=True)
        link.symlink_to(f"../..{program}")

    def _place_documents(self) -> None:
        folder = self.root / _DOC
        (folder / "examples").mkdir(parents=True)
        for name in EXAMPLES:
            shutil.copy(TREE / "config" / name, folder / "examples")
        shutil.copy(TREE / "README.md", folder)
        shutil.copytree(TREE / "docs", folder / "docs")
        (folder / "copyright").write_text(copyright_text(self.packages), "utf-8")
        (folder / "packages.txt").write_text("".join(f"{one.name}=={one.version}\n" for one in self.packages), "utf-8")
        news = (TREE / "CHANGELOG.md").read_bytes()
        (folder / "changelog.gz").write_bytes(gzip.compress(news, mtime=0))

    def _try_out(self) -> None:
        """Let the staged program do what it is for, before it is packed."""
        shown = json.loads(self._program("demo", "--fast", "--json").splitlines()[-1])
        if not isinstance(shown, dict):
            raise BuildError(f"the staged program gave no object for `demo --fast --json`: {shown}")

    def _program(self, *arguments: str) -> str:
        return _run(str(self._opt / "bin/python3"), "-B", str(self._opt / "bin" / NAME), *arguments)

    def _tidy(self) -> None:
        """Leave out what only pip, a shell or a test of others needs, and byte-compile the rest."""
        kept = {NAME, "python", "python3", "python{}.{}".format(*self.python)}
        for path in (self._opt / "bin").iterdir():
            if path.name not in kept:
                path.unlink()
        for name in ("include", "share"):
            shutil.rmtree(self._opt / name, ignore_errors=True)
        for path in self._site().glob("*.dist-info/direct_url.json"):  # a folder of this build
            path.unlink()
        for folder in [*self._site().rglob("tests"), *self._site().rglob("__pycache__")]:
            shutil.rmtree(folder, ignore_errors=True)
        program = self._opt / "bin" / NAME
        program.write_text(re.sub(r"\A#!.*", f"#!/{_OPT}/bin/python3", program.read_text("utf-8")), "utf-8")
        settings = self._opt / "pyvenv.cfg"
        lines = settings.read_text("utf-8").splitlines(keepends=True)
        settings.write_text("".join(line for line in lines if str(self.root) not in line), "utf-8")
        # By the source's hash, which nobody checks: neither a date nor a start of the program can make it stale.
        compiling = ("-m", "compileall", "-q", "-f", "--invalidation-mode", "unchecked-hash")
        _run(str(self._opt / "bin/python3"), *compiling, "-s", str(self.root), "-p", "/", str(self._site()))
        for path in [self.root, *self.root.rglob("*")]:
            if not path.is_symlink():
                path.chmod(0o755 if path.is_dir() or path.stat().st_mode & 0o100 else 0o644)
            os.utime(path, (self._date, self._date), follow_symlinks=False)

    def files(self) -> list[str]:
        """Return the paths of the files and links, below ``/``."""
        found = (path for path in self.root.rglob("*") if path.is_symlink() or path.is_file())
        return sorted(str(path.relative_to(self.root)) for path in found)


def pack(stage: Stage, output: Path, architecture: str, date: int) -> Path:
    """Pack the staged files with the control files; return the package's path."""
    folder = stage.root / "DEBIAN"
    files = [path for path in stage.files() if not (stage.root / path).is_symlink()]
    size = sum((stage.root / path).stat().st_size // 1024 + 1 for path in files)
    folder.mkdir(mode=0o755)
    sums = (hashlib.md5((stage.root / path).read_bytes(), usedforsecurity=False).hexdigest() for path in files)
    texts = {
        "control": control_text(version(date), architecture, stage.python, oldest_libc(stage.packages), size),
        "md5sums": "".join(f"{value}  {path}\n" for value, path in zip(sums, files, strict=True)),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, "utf-8")
        (folder / name).chmod(0o644)
    for name in SCRIPTS:
        shutil.copyfile(HERE / name, folder / name)
        (folder / name).chmod(0o755)
    package = output / f"{NAME}_{version(date)}_{architecture}.deb"
    _run(
        "dpkg-deb", "--root-owner-group", "-Zzstd", "-z19", "--build", str(stage.root), str(package),
        environment={"SOURCE_DATE_EPOCH": str(date)},
    )  # fmt: skip
    return package


def build(output: Path, wheels: Path | None) -> dict[str, Any]:
    """Build the package into a folder, and return what is worth knowing about it.

    Raises
    ------
    BuildError
        When a tool is missing, or one has failed.
    """
    for tool, of in (("dpkg-deb", "dpkg"), (_PYTHON, "python3")):
        if shutil.which(tool) is None:
            raise BuildError(f"{tool} is missing: build on Debian or Ubuntu, with `apt install {of}`")
    if wheels is not None and not wheels.is_dir():
        raise BuildError(f"{wheels} is no folder; --wheels wants the one with the wheels")
    architecture = _run("dpkg", "--print-architecture").strip()
    date = int(os.environ.get("SOURCE_DATE_EPOCH") or _newest())
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="twostage-servo-deb-") as name:
        work = Path(name)
        stage = Stage(work / "stage", date)
        stage.root.mkdir()
        stage.build(work, wheels)
        files = stage.files()
        installed = sum((stage.root / path).lstat().st_size for path in files)
        package = pack(stage, output, architecture, date)
        packages = {one.name: one.version for one in stage.packages}
    return {
        "package": str(package.resolve()), "version": version(date), "architecture": architecture,
        "bytes": package.stat().st_size, "sha256": hashlib.sha256(package.read_bytes()).hexdigest(),
        "installed_bytes": installed, "files": len(files), "python": "{}.{}".format(*stage.python),
        "date": date, "packages": packages,
        "install": f"sudo apt install {package.resolve()}",
    }  # fmt: skip


def _newest() -> int:
    """Return the date of the newest source, so that the same tree and the same wheels give the same bytes."""
    sources = [TREE / name for name in _TOP_FILES]
    for name in (*_SOURCES, "docs"):
        sources += [path for path in (TREE / name).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return int(max(path.stat().st_mtime for path in [*sources, *HERE.iterdir()] if path.is_file()))


def _run(*arguments: str, environment: Mapping[str, str] | None = None) -> str:
    """Run a program without what the caller's Python is told by its environment; return what it printed."""
    passed = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(
        arguments, env=passed | {"LC_ALL": "C.UTF-8"} | dict(environment or {}), stdin=subprocess.DEVNULL,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        told = (done.stderr.strip() or done.stdout.strip())[-2000:]
        raise BuildError(f"`{' '.join(arguments)}` ended with {done.returncode}:\n{told}")
    return done.stdout


def main() -> int:
    """Build, and return the exit code: 1 if it cannot be built."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("dist"), metavar="FOLDER", help="for it (default dist)")
    parser.add_argument("--wheels", type=Path, metavar="FOLDER", help="use the wheels in there alone, and no network")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    try:
        built = build(options.output, options.wheels)
    except (BuildError, OSError) as error:
        print(f"build: {error}", file=sys.stderr)
        if options.json:
            print(json.dumps({"error": str(error)}))
        return 1
    if options.json:
        print(json.dumps(built))
    else:
        sizes = (built[key] / 1e6 for key in ("bytes", "installed_bytes"))
        print("{}\n{:.1f} MB; installed {:.1f} MB in {} files".format(built["package"], *sizes, built["files"]))
        print(f"{len(built['packages'])} Python packages, for Python {built['python']}\ninstall it: {built['install']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
