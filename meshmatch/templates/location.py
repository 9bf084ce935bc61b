"""Location of the template bundles, trained models and sample shapes that are part of the package."""

from pathlib import Path

from meshmatch.errors import TemplateError


def bundled_folder() -> Path:
    """The folder of bundled data: ``meshmatch/_templates`` of an installed wheel, ``templates/`` beside a checkout.

    It contains ``human/`` (template bundles), ``models/NAME/`` (trained models), ``rigs/`` (data for generated animals),
    ``measurements/`` (the reference body of measurements) and ``samples/`` (example shapes).
    The wheel's copy takes precedence; a checkout is only recognised by its ``pyproject.toml``, so that an installed package
    never reads an unrelated ``templates/``. `TemplateError` if there is neither.
    """
    package = Path(__file__).resolve().parents[1]
    installed, beside = package / "_templates", package.parent / "templates"
    if installed.is_dir():
        return installed
    if (package.parent / "pyproject.toml").is_file() and beside.is_dir():
        return beside
    problem = f"the templates and models that come with meshmatch are neither in {installed} nor in {beside}"
    raise TemplateError(problem, "the installation is incomplete: install meshmatch again")
