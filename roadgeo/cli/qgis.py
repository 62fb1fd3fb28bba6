"""`roadgeo qgis`: the QGIS plugin into a profile, or into a package."""

from __future__ import annotations

import os
from dataclasses import dataclass

import click

from roadgeo._options import OTHERS, option
from roadgeo.cli import Group
from roadgeo.cli.options import Once, command
from roadgeo.cli.printing import echo

__all__ = ["qgis_command"]


@click.group("qgis", cls=Group, short_help="Install the QGIS plugin.")
def qgis_command() -> None:
    """Put roadgeo into QGIS: a plugin with a menu, that adds its commands to the Processing toolbox.

    \b
    Examples:
      roadgeo qgis install
      roadgeo qgis install --profile surveys
      roadgeo qgis package --out roadgeo_qgis.zip
    """


# fmt: off
@dataclass(frozen=True, kw_only=True)
class Install:
    """The parameters of `roadgeo qgis install`."""

    profile: str = option("--profile", "PROFILE", OTHERS,
        "A profile's name, as QGIS shows it in Settings > User Profiles, or its folder.",
        default="default", show_default=True)


@dataclass(frozen=True, kw_only=True)
class Package:
    """The parameters of `roadgeo qgis package`."""

    out: str | None = option("-o --out", "FILE", OTHERS, "The package. Default: roadgeo_qgis-VERSION.zip.",
        type=click.Path(dir_okay=False))
    email: str | None = option("--email", "ADDRESS", OTHERS,
        "The publisher's. Default, here and below: as the package says.")
    repository: str | None = option("--repository", "URL", OTHERS, "Where the source code is.")
    tracker: str | None = option("--tracker", "URL", OTHERS, "Where to report problems.")
    homepage: str | None = option("--homepage", "URL", OTHERS, "Where the documentation is.")
# fmt: on


@command("install", Install, Once, group=qgis_command, short_help="Put the plugin into a QGIS profile.")
def install_command(asked: Install) -> None:
    """Put the plugin into a QGIS profile, in place of an earlier version, and enable it there.

    It calls the roadgeo that installed it; another one is set in QGIS, by Plugins > roadgeo > Set up roadgeo.

    \b
    Examples:
      roadgeo qgis install
      roadgeo qgis install --profile surveys
    """
    from roadgeo.qgis.installation import find_profiles, install_plugin

    for folder in find_profiles(asked.profile):
        echo(f"installed {install_plugin(folder)}")
    if "VIRTUAL_ENV" in os.environ:
        echo("Leave the environment first (deactivate): QGIS would take its Python for its own.", err=True)
    echo("Start QGIS anew: the Processing toolbox has a group roadgeo.", err=True)


@command("package", Package, Once, group=qgis_command, short_help="Make the plugin's package.")
def package_command(asked: Package) -> None:
    """Make the package that QGIS installs (Plugins > Manage and Install Plugins > Install from ZIP).

    QGIS's plugin repository (plugins.qgis.org) takes the same package. It asks for the publisher's address, for the
    source code and for where to report problems: give yours.

    \b
    Examples:
      roadgeo qgis package
      roadgeo qgis package --out roadgeo_qgis.zip
    """
    from roadgeo._version import __version__
    from roadgeo.qgis.installation import NAME, write_package

    path = asked.out or f"{NAME}-{__version__}.zip"
    write_package(path, {key: value for key, value in vars(asked).items() if value and key != "out"})
    echo(f"wrote {path}")
