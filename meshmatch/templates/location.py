"""Where the template bundles, trained models and sample shapes that come with the package are."""

from pathlib import Path


def bundled_folder() -> Path:
    """The folder of bundled data: ``meshmatch/_templates`` of an installed wheel, ``templates/`` beside a checkout.

    It holds ``human/`` (template bundles), ``models/NAME/`` (trained models) and ``samples/`` (two shapes to try).
    The wheel's own copy wins, so that an installed package never reads a stranger's ``templates/``.
    """
    package = Path(__file__).resolve().parents[1]
    installed = package / "_templates"
    return installed if installed.is_dir() else package.parent / "templates"
