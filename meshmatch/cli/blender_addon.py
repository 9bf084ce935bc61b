"""``meshmatch blender-addon``."""

import zipfile
from pathlib import Path

from meshmatch import __version__
from meshmatch.blender import SCRIPTS
from meshmatch.cli.options import Json, Quiet, output_option
from meshmatch.cli.user_messages import Console, print_json
from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success


def blender_addon(
    *, output: Path = output_option("ZIP", "The extension: .zip."), json: Json = False, quiet: Quiet = False
) -> None:
    """Write an extension for Blender 4.2 or newer.

    It runs meshmatch on two objects of a scene. In Blender: Edit, Preferences, Get Extensions, Install from Disk. Its
    panel is in the sidebar of the 3D view.
    """
    if output.suffix.lower() != ".zip":
        raise OptionError(f"{output.name or output}: an extension for Blender is a zip", "end the name in .zip")
    with replace_on_success(output) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted((SCRIPTS / "addon").glob("*.*")):
            text = file.read_text(encoding="utf-8").replace('version = "VERSION"', f'version = "{__version__}"')
            archive.writestr(zipfile.ZipInfo(file.name), text, zipfile.ZIP_DEFLATED)  # the same bytes every day
    Console(quiet).say(f"wrote {output}: in Blender, Edit > Preferences > Get Extensions > Install from Disk")
    if json:
        print_json({"output": output, "version": __version__})
