"""Ground floor: rows and vector environments of teams, checks, errors, files and random numbers for all rooms."""

from importlib.metadata import PackageNotFoundError, version


def package_version() -> str:
    """Return the version of this package, ``"0+unknown"`` in a checkout without installation."""
    try:
        return version("sb3-saf")
    except PackageNotFoundError:
        return "0+unknown"
