"""Names as an operator types them: of files, of sockets, of axes and of keys."""

import argparse
import os
from pathlib import Path


def file_path(text: str) -> Path:
    """Return a path: an empty one, such as that of a variable that is not set, would be the current folder.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is empty.
    """
    if not text:
        raise argparse.ArgumentTypeError("the path is empty: name a file, or leave the option out")
    return Path(text)


def utf8(text: str) -> str:
    """Return a text in UTF-8, as configurations and services have it, whatever encoding the locale names.

    Where it names none but ASCII, Python keeps the bytes of any other character as surrogates.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is none.
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        try:
            return os.fsencode(text).decode()
        except UnicodeError as error:
            raise argparse.ArgumentTypeError(f"{text!a} is not UTF-8") from error
    return text
