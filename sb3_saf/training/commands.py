"""Helpers of the commands: options as ``key:value``, and one-line errors with a fix."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import reprlib
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any, NoReturn, TypeVar

import torch as th

from sb3_saf.suites.registry import HOW_TO_NAME
from sb3_saf.training.yaml_files import load_yaml

USAGE_ERROR = 2

Result = TypeVar("Result")


class CommandError(Exception):
    """Raised for an error that the user can fix; commands print it in one line and exit."""


@contextmanager
def user_errors(*kinds: type[Exception]) -> Iterator[None]:
    """Convert errors that the user can fix (ValueError by default) to :class:`CommandError`, without traceback."""
    caught = kinds or (ValueError,)
    try:
        yield
    except caught as error:
        raise CommandError(str(error) or type(error).__name__) from error


class OneLineParser(argparse.ArgumentParser):
    """Parser with one-line errors, without the usage text."""

    def error(self, message: str) -> NoReturn:
        """Print the error and a hint to ``--help``, and exit."""
        self.exit(USAGE_ERROR, f"{self.prog}: error: {' '.join(message.split())} (--help lists the options)\n")


class DefaultsFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Help formatter that shows defaults if there are any."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default in (None, "", False) or action.default == {}:
            return action.help
        return super()._get_help_string(action)


class KeyValues(argparse.Action):
    """Action that parses ``--option a:1 b:rgb`` to a dict. Values are YAML, never Python."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        """Add the pairs to those of earlier uses of the option."""
        pairs = dict(getattr(namespace, self.dest) or {})
        for text in values or ():
            key, colon, value = str(text).partition(":")
            if not colon or not key or not value:
                parser.error(f"{option_string} expects key:value, such as coordination:2, got {text!r}")
            try:
                given, before = load_yaml(value, f"the value {reprlib.repr(value)}"), pairs.get(key)
                pairs[key] = {**before, **given} if isinstance(given, dict) and isinstance(before, dict) else given
            except ValueError as error:
                parser.error(str(error))
        setattr(namespace, self.dest, pairs)


def add_key_values(
    parser: argparse._ActionsContainer, *flags: str, help: str, metavar: str = "KEY:VALUE"
) -> None:  # argparse's own name
    """Add an option with a dict as value, see :class:`KeyValues`."""
    parser.add_argument(*flags, nargs="+", action=KeyValues, default={}, metavar=metavar, help=help)


def at_least(lowest: int, default: int | None = None) -> Callable[[str], int]:
    """Return a type for argparse: integers of at least ``lowest``, or ``default``, which means no number."""

    def whole_number(text: str) -> int:
        value = int(text)
        if value < lowest and value != default:
            or_default = "" if default is None else f", or {default}"
            raise argparse.ArgumentTypeError(f"must be at least {lowest}{or_default}, got {value}")
        return value

    return whole_number


def option_words(option: str, pairs: Mapping[str, Any]) -> list[str]:
    """Return the command line words for an option of :class:`KeyValues`; none if there are no pairs."""
    return [option, *(f"{key}:{json.dumps(value)}" for key, value in pairs.items())] if pairs else []


def run_command(program: str, command: Callable[[], Result]) -> Result:
    """Run a command; print user errors and file errors in one line on stderr and exit with code 2."""
    try:
        result = command()
        sys.stdout.flush()
        return result
    except BrokenPipeError:  # the reader of the pipe has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except (CommandError, OSError) as error:
        print(f"{program}: error: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(USAGE_ERROR) from None
    except KeyboardInterrupt:
        raise SystemExit(128 + signal.SIGINT) from None


def require(*modules: str) -> None:
    """Check that optional packages are installed; otherwise raise a :class:`CommandError` with the install command."""
    for module in modules:
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            raise CommandError(
                f"this command needs {error.name}, which is not installed: pip install 'sb3-saf[render,zoo]'"
            ) from None


def imported_module(name: str) -> ModuleType:
    """Import a module; a type for argparse."""
    try:
        return importlib.import_module(name)
    except (ImportError, TypeError, ValueError) as error:  # argparse hides the last two
        raise argparse.ArgumentTypeError(f"cannot import {name!r}: {error}") from error


def add_environment_options(parser: argparse._ActionsContainer, of_level: str) -> None:
    """Add ``--env``, ``--env-kwargs`` (with the help ``of_level``) and ``--gym-packages``."""
    parser.add_argument("--env", default="TeamTogether-v0", help=HOW_TO_NAME)
    add_key_values(parser, "--env-kwargs", help=of_level)
    add_gym_packages(parser)


def add_gym_packages(parser: argparse._ActionsContainer) -> None:
    """Add ``--gym-packages``, which are imported at once."""
    text = "modules to import, which register environments"
    parser.add_argument("--gym-packages", nargs="+", type=imported_module, default=[], metavar="MODULE", help=text)


def check_device(device: str) -> str:
    """
    Return a device's name if the device is available; Stable-Baselines3 would silently train on the CPU.

    :param device: as in SB3: ``"auto"``, ``"cpu"``, ``"cuda"``, ``"cuda:1"``, ...
    :raises ValueError: with the available devices
    """
    if device == "auto":
        return device
    try:
        th.empty(1, device=device)
    except (RuntimeError, NotImplementedError, AssertionError) as error:
        count = th.cuda.device_count() if th.cuda.is_available() else 0
        raise ValueError(
            f"expected a --device that torch can use, such as auto, cpu, cuda or cuda:1, got {device!r}: "
            f"{str(error)[:200].splitlines()[0]}; torch {th.__version__} sees {count or 'no'} CUDA devices: take "
            "--device cpu or auto, or check the driver (nvidia-smi) and that torch was built for CUDA (python -c "
            "'import torch; print(torch.version.cuda)')"
        ) from None
    return device
