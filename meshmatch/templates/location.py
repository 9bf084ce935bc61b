"""Where the template bundles, trained models and sample shapes that come with the package are."""

from pathlib import Path

from meshmatch.errors import TemplateError


def bundled_folder() -> Path:
    """The folder of bundled data: ``meshmatch/_templates`` of an installed wheel, ``templates/`` beside a checkout.

    It holds ``human/`` (template bundles), ``models/NAME/`` (trained models), ``rigs/`` (what animals are made from),
    ``measurements/`` (a body to measure by) and ``samples/`` (shapes to try).
    The wheel's own copy wins, and of a checkout only one with its ``pyproject.toml``, so that an installed package
    never reads a stranger's ``templates/``. `TemplateError` if there is neither.
    """
    package = Path(__file__).resolve().parents[1]
    installed, beside = package / "_templates", package.parent / "templates"
    if installed.is_dir():
        return installed
    if (package.parent / "pyproject.toml").is_file() and beside.is_dir():
        return beside
    problem = f"the templates and models that come with meshmatch are neither in {installed} nor in {beside}"
    raise TemplateError(problem, "the installation is incomplete: install meshmatch again")
