"""`train` hands everything on to the training run; the run itself has tests of its own."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import meshmatch
from meshmatch.cli.train import TrainOptions, _calibrate, _forecast
from meshmatch.cli.user_messages import Console
from meshmatch.generators.generator import Generator
from meshmatch.generators.kinds import GENERATORS
from meshmatch.models.card import ModelCard, read_card, write_card
from meshmatch.progress import ProgressCallback
from meshmatch.templates.location import bundled_folder
from meshmatch.training import train as training
from meshmatch.training.loop import StepReport
from meshmatch.training.recipes import clouds, recipe_for
from tests.cli.conftest import Run
from tests.fitting.eggs import egg_template
from tests.generators.momentum_files import write_rig
from tests.models.small_model import small_card


class Recorder:
    """Stands for the training run."""

    def __init__(self) -> None:
        self.bodies: tuple[Any, ...] = ()
        self.called: dict[str, Any] = {}
        self.poses: Any = None
        self.characters: Any = None
        self.stylised: Any = None
        self.drawn = 0

    def people_source(self, template: Any, bodies: Any, seed: int, progress: Any) -> Any:
        self.bodies = (template.name, bodies.identities, seed)
        self.poses, self.characters, self.stylised = bodies.poses, bodies.characters, bodies.stylised
        progress(0.5)
        return self.draw if bodies.bodies else "bodies"

    def draw(self, count: int, generator: torch.Generator) -> torch.Tensor:
        self.drawn += count
        return torch.rand(count, 4, 3, generator=generator)

    def train_model(self, *given: Any) -> Path:
        template, source, output, recipe, facts, resume, report, unseen, self.tensorboard, *_ = given
        told = {"template": template.name, "source": source, "output": output, "recipe": recipe, "resume": resume}
        self.called = told | vars(facts) | {"unseen": unseen}
        report(StepReport(1, 2, 1e-3, 4.0, {"total": 0.5}, 0.04))
        report(StepReport(2, 2, 1e-3, 8.0, {"total": 0.25}, 0.0321))
        card = read_card(bundled_folder() / "models" / "human" / "card.json")
        metrics = {"validation": {"distance": 0.0321}}
        settings = card.recipe | {"validation": facts.measured}
        card = replace(card, name=facts.name, steps=2, metrics=metrics, recipe=settings)
        write_card(card, Path(output) / "card.json")
        return Path(output)


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    recorder = Recorder()
    monkeypatch.setattr("meshmatch.training.load_data.people_source", recorder.people_source)
    monkeypatch.setattr(training, "train_model", recorder.train_model)
    monkeypatch.delenv("RANK", raising=False)
    return recorder


def test_defaults(run: Run, stub: Recorder, tmp_path: Path) -> None:
    answer = run("train", "-o", tmp_path / "my own", "--name", "mine")
    assert (answer.status, answer.out) == (0, "")
    assert stub.bodies == ("human-T", 4096, 0)
    called = stub.called
    assert (called["template"], called["source"]) == ("human-T", "bodies")
    assert (called["name"], called["category"], called["resume"]) == ("mine", "human", True)
    assert "anny" in called["data"]
    assert called["licence"] == "unstated"
    assert called["start"] is None
    assert called["recipe"] == recipe_for()
    assert "step 2 of 2: total 0.25, validation 0.0321 (8 s)" in answer.err
    assert "validation error: 3.2 % of sqrt(area) on shapes that were not trained on, still falling" in answer.err
    assert f"meshmatch models add '{tmp_path / 'my own'}'" in answer.err
    assert "unfinished: step 2 of 13,000; the same command continues" in answer.err


def test_a_card_is_a_recipe_and_options_change_it(run: Run, stub: Recorder, tmp_path: Path) -> None:
    card = bundled_folder() / "models" / "hand" / "card.json"
    assert run("train", "-o", tmp_path / "mine", "--recipe", card, "--steps", 9, "--device", "cpu").status == 0
    found = stub.called["recipe"]
    assert (found.train.steps, found.train.shapes, found.network.code, found.train.device) == (9, 16, 384, "cpu")
    answer = run("train", "-o", tmp_path / "other", "--recipe", card, "--preset", "paper")
    assert answer.status == 1 and "--preset does not go with --recipe" in answer.err


@pytest.mark.parametrize("words", [("--template", "human-T"), ("--identities", "8")])
def test_a_prepared_folder_has_its_own_template(
    run: Run, stub: Recorder, tmp_path: Path, words: tuple[str, str]
) -> None:
    (tmp_path / "prepared").mkdir()
    answer = run("train", "--shapes", tmp_path / "prepared", "-o", tmp_path / "mine", *words)
    assert (answer.status, f"{words[0]} does not go with a prepared folder" in answer.err) == (1, True)


def test_a_model_does_not_go_into_what_it_learns_from(run: Run, stub: Recorder, tmp_path: Path) -> None:
    (tmp_path / "prepared").mkdir()
    answer = run("train", "--shapes", tmp_path / "prepared", "-o", tmp_path / "prepared")
    assert (answer.status, "is an input of this command" in answer.err) == (1, True)


def test_half_of_the_people_are_characters_unless_another_share_is_asked_for(
    run: Run, stub: Recorder, tmp_path: Path
) -> None:
    assert run("train", "-o", tmp_path / "mine").status == 0
    assert stub.characters == recipe_for().characters == 0.5
    assert "50% of them characters" in stub.called["data"]
    assert run("train", "-o", tmp_path / "naked", "--characters", 0).status == 0
    assert stub.characters == 0
    assert "characters" not in stub.called["data"]
    assert run("train", "-o", tmp_path / "paper", "--preset", "paper").status == 0
    assert stub.characters == 0


def test_how_many_are_stylised_is_the_users_and_the_recipes(run: Run, stub: Recorder, tmp_path: Path) -> None:
    assert run("train", "-o", tmp_path / "usual").status == 0
    assert stub.stylised is None and "stylised or" in stub.called["data"]
    assert run("train", "-o", tmp_path / "more", "--stylised", 0.4).status == 0
    assert stub.stylised == 0.4 and "stylised (40% of these) or" in stub.called["data"]
    card = tmp_path / "card.json"
    card.write_text('{"recipe": {"stylised": 0.3, "characters": 0.8}}')
    assert run("train", "-o", tmp_path / "read", "--recipe", card).status == 0
    assert (stub.stylised, stub.characters) == (0.3, 0.8)


def test_scanned_bodies_are_mixed_in(run: Run, stub: Recorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_rig(tmp_path / "rig")
    answer = run("train", "-o", tmp_path / "mine", "--mhr", tmp_path / "rig", "--mhr-share", 1.5)
    assert answer.status == 2 and "--mhr-share" in answer.err
    answer = run("train", "-o", tmp_path / "mine", "--mhr", tmp_path)
    assert answer.status == 1 and "lod3.fbx cannot be read" in answer.err
    monkeypatch.setattr("meshmatch.api.scanned.read_momentum_rig", None)  # told before a body is fitted
    answer = run("train", "-o", tmp_path / "mine", "--mhr", tmp_path / "rig", "--kind", "hand")
    assert answer.status == 1 and "--mhr" in answer.err


def test_bodies_are_drawn_once_where_so_many_are_asked_for(run: Run, stub: Recorder, tmp_path: Path) -> None:
    assert run("train", "-o", tmp_path / "mine", "--bodies", 70).status == 0
    source = stub.called["source"]
    assert stub.drawn == 70 and "70 bodies, drawn once" in stub.called["data"]
    many = source(1000, torch.Generator().manual_seed(1))
    assert len(many.unique(dim=0)) == 70 and stub.drawn == 70
    assert len(stub.called["unseen"](5, torch.Generator())) == 5 and stub.drawn == 75  # what is measured on is new
    assert run("train", "-o", tmp_path / "paper", "--preset", "paper").status == 0
    assert stub.drawn == 1075 and "1000 bodies, drawn once" in stub.called["data"]
    assert run("train", "-o", tmp_path / "paper", "--preset", "paper", "--bodies", 0).status == 0
    assert stub.called["source"] == "bodies" and "once" not in stub.called["data"]


@pytest.mark.parametrize(
    ("words", "part", "name", "value"),
    [
        ("--steps 7", "train", "steps", 7),
        ("--minutes 1.5", "train", "minutes", 1.5),
        ("--bf16", "train", "bf16", True),
        ("--no-bf16", "train", "bf16", False),
        ("--tf32", "train", "tf32", True),
        ("--compile", "train", "compile", True),
        ("--draw cpu", "train", "draw", "cpu"),
        ("--workers 0", "train", "workers", 0),
        ("--threads 2", "train", "threads", 2),
        ("--seed 5", "train", "seed", 5),
        ("--rate 0.01", "train", "rate", 0.01),
        ("--points 512", "scan", "points", 512),
        ("--volume 1", "loss", "volume", 1.0),
        ("--arap 1", "loss", "arap", 1.0),
        ("--blend 1", "loss", "blend", 1.0),
    ],
)
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_an_option_changes_one_thing_of_the_preset(
    run: Run, stub: Recorder, tmp_path: Path, preset: Any, words: str, part: str, name: str, value: object
) -> None:
    assert run("train", "-o", tmp_path / "mine", "--preset", preset, *words.split()).status == 0
    usual = recipe_for(preset=preset)
    change: dict[str, Any] = {name: value}
    if part == "loss":
        part, change = "train", {"loss": replace(usual.train.loss, **change)}
    assert stub.called["recipe"] == replace(usual, **{part: replace(getattr(usual, part), **change)})


@pytest.mark.parametrize(
    ("words", "heard"),
    [
        ("--name other", {"name": "other"}),
        ("--category cat", {"category": "cat"}),
        ("--licence CC0-1.0", {"licence": "CC0-1.0"}),
        ("--fresh", {"resume": False}),
        ("--template human-A", {"template": "human-A"}),
        (f"--template {bundled_folder() / 'human' / 'human-I.safetensors'}", {"template": "human-I"}),
        ("--preset paper", {"bodies": ("human-T-300", 4096, 0)}),
        ("--preset paper --template human-A", {"bodies": ("human-A", 4096, 0)}),
        ("--identities 10 --seed 3", {"bodies": ("human-T", 10, 3)}),
        ("--kind human --identities 10", {"bodies": ("human-T", 10, 0)}),
    ],
)
def test_options_reach_the_run(run: Run, stub: Recorder, tmp_path: Path, words: str, heard: dict[str, object]) -> None:
    assert run("train", "-o", tmp_path / "mine", *words.split()).status == 0
    assert (stub.called | {"bodies": stub.bodies}).items() >= heard.items()


def test_a_training_starts_from_a_model(run: Run, stub: Recorder, tmp_path: Path) -> None:
    assert run("train", "-o", tmp_path / "mine", "--start", "human").status == 0
    assert stub.called["start"].card.name == "human"
    answer = run("train", "-o", tmp_path / "mine", "--start", "humam")
    assert answer.status == 1
    assert "human" in answer.err


def test_a_kind_is_generated(run: Run, stub: Recorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int]] = []

    def made(identities: int, seed: int, progress: Any) -> Generator:
        asked.append((identities, seed))
        return Generator("head", egg_template(), torch.zeros, "eggs, painted")

    monkeypatch.setitem(GENERATORS, "head", made)
    answer = run("train", "-o", tmp_path / "mine", "--kind", "head", "--seed", 3)
    assert answer.status == 0, answer.err
    assert stub.called["recipe"] == recipe_for(kind="head").changed(seed=3) != recipe_for()
    assert (stub.called["category"], stub.called["data"]) == ("head", "eggs, painted")
    assert stub.called["source"] is torch.zeros
    run("train", "-o", tmp_path / "mine", "--kind", "head", "--identities", 7)
    assert asked == [(1024, 3), (7, 0)]
    assert stub.bodies == ()


def test_poses_of_a_file_are_mixed_in(run: Run, stub: Recorder, tmp_path: Path) -> None:
    poses = tmp_path / "dance.csv"
    poses.write_text("pose,joint,x,y,z\n1,head,0,1,0\n2,head,0,-1,0\n")
    assert run("train", "-o", tmp_path / "mine", "--poses", poses).status == 0
    assert (stub.poses.joints, stub.poses.P, stub.poses.share) == (("head",), 2, 0.5)
    assert stub.called["data"].endswith("50% of them in 2 poses of dance.csv")
    assert run("train", "-o", tmp_path / "mine", "--poses", poses, "--pose-share", "0.2").status == 0
    assert stub.poses.share == 0.2
    assert run("train", "-o", tmp_path / "mine").status == 0
    assert stub.poses is None
    assert "dance" not in stub.called["data"]


def test_a_prepared_folder_brings_its_template(
    run: Run, stub: Recorder, tmp_path: Path, two: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("meshmatch.render.compose.render_shapes", lambda *_: None)
    for name in ("eggs/one.ply", "eggs/two.ply"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(two[0].read_bytes())
    words = ("-o", tmp_path / "ready", "--nodes", "60", "--radius", "0.3", "-q")
    assert run("prepare", tmp_path / "eggs", *words).status == 0
    answer = run("train", "-o", tmp_path / "mine", "--shapes", tmp_path / "ready")
    assert (answer.status, "validation error: 3.2 % of sqrt(area) on the learned shapes, drawn anew" in answer.err) == (
        0,
        True,
    )
    assert stub.bodies == ()
    assert (stub.called["template"], stub.called["category"]) == ("eggs", "mine")
    assert stub.called["data"] == "2 registered shapes of ready"


def test_json(run: Run, stub: Recorder, tmp_path: Path) -> None:
    answer = run("train", "-o", tmp_path / "mine", "--json", "--quiet")
    record = answer.record
    assert answer.err == ""
    assert (record["model"], record["steps"]) == ("mine", 2)
    assert "metrics" in record


def test_of_several_processes_one_speaks(
    run: Run, stub: Recorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RANK", "1")
    answer = run("train", "-o", tmp_path / "mine", "--json")
    assert (answer.status, answer.out, answer.err) == (0, "", "")


@pytest.mark.parametrize(
    ("words", "status", "told"),
    [
        ("--template human-X", 1, "human-X"),
        ("--shapes nowhere", 1, "nowhere"),
        ("--name ../up", 1, "../up"),
        ("--preset best", 2, "best"),
        ("--steps 0", 2, "--steps"),
        ("--identities 1000001", 2, "--identities"),
        ("--stiffness inf", 2, "--stiffness"),
        ("--poses nowhere.npz", 1, "nowhere.npz"),
        ("--poses dance.bvh", 1, "dance.bvh"),
        ("--pose-share 1.5", 2, "--pose-share"),
        ("--kind cat", 2, "cat"),
        ("--kind hand --template human-A", 1, "--template does not go"),
        ("--kind hand --characters 0.5", 1, "--characters does not go"),
        ("--kind hand --stylised 0.5", 1, "--stylised does not go"),
        ("--kind hand --bodies 5", 1, "--bodies does not go"),
        ("--picture l.jpg", 1, "l.jpg"),
        ("--picture nowhere/l.png", 1, "there is no folder"),
        ("--bodies 20001", 1, "20,000"),
        ("--kind human --shapes nowhere", 1, "cannot be combined with a folder"),
    ],
)
def test_what_cannot_be_is_told(run: Run, stub: Recorder, tmp_path: Path, words: str, status: int, told: str) -> None:
    answer = run("train", "-o", tmp_path / "mine", *words.split())
    assert answer.status == status
    assert told in answer.err
    assert stub.called == {}


def test_the_losses_as_a_picture(run: Run, stub: Recorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from meshmatch.render import charts

    drawn: dict[str, Any] = {}

    def kept(path: Path, steps: Any, terms: Any, validation: Any) -> None:
        drawn.update(path=path, steps=steps, terms=terms, validation=validation)

    monkeypatch.setattr(charts, "draw_losses", kept)
    picture = tmp_path / "mine" / "losses.png"  # in the folder that is made first
    answer = run("train", "-o", tmp_path / "mine", "--picture", picture, "--json")
    assert answer.status == 0, answer.err
    assert drawn == {
        "path": picture,
        "steps": [1, 2],
        "terms": {"total": [0.5, 0.25]},
        "validation": {1: 0.04, 2: 0.0321},
    }
    assert f"drew {picture}" in answer.err
    assert answer.record["picture"] == str(picture)
    drawn.clear()
    monkeypatch.setenv("RANK", "1")
    assert run("train", "-o", tmp_path / "mine", "--picture", picture).status == 0
    assert drawn == {}


def test_a_run_without_a_report_has_no_picture(
    run: Run, stub: Recorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "train_model", lambda *_, **__: tmp_path / "mine")
    answer = run("train", "-o", tmp_path / "mine", "--picture", tmp_path / "l.png")
    assert "was not drawn" in answer.err
    assert not (tmp_path / "l.png").exists()


@pytest.mark.parametrize(
    ("field", "minutes", "words"),
    [
        ("mls", None, "about 10 min of training, then less than a minute to fit 9 of the shapes, to calibrate"),
        ("pointwise", None, r"about 10 min of training, then about \d+ min to fit 9 of the shapes, to calibrate"),
        ("pointwise", 3.0, r"about 3 min of training, then about \d+ min to fit 9 "),
        (None, None, "about 10 min of training$"),
    ],
)
def test_how_long_it_takes_is_told_after_the_first_steps(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    field: Any,
    minutes: Any,
    words: str,
) -> None:
    for number in range(9):
        (tmp_path / f"{number}.ply").touch()
    clock = iter([100.0, 103.0, 112.0, 200.0])
    monkeypatch.setattr("meshmatch.cli.train.time.monotonic", lambda: next(clock))
    recipe = None if field is None else clouds().changed(field=field)
    told: list[Any] = []
    how = TrainOptions(shapes=tmp_path, minutes=minutes)
    report = _forecast(Console(), lambda *each: told.append(each), 500, how, recipe)
    report("making shapes (once)", "shapes", 0.5)
    report("orientations alone (once)", "training", 0.5)
    for step in (10, 12, 20, 30):
        report(f"step {step} of 500", "training", step / 500)
    said = capsys.readouterr().err.splitlines()
    assert len(told) == 6 and len(said) == 1 and re.search(words, said[0])


def test_fits_that_calibrate_a_model_are_told_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter([0.0, 90.0, 360.0, 990.0])
    monkeypatch.setattr("meshmatch.cli.train.time.monotonic", lambda: next(clock))

    def calibrate(output: Path, shapes: Path, threads: int, progress: ProgressCallback) -> ModelCard:
        progress("refinement", "a.ply", 0.5)
        for done in (1, 4, 11):
            progress("shapes", f"{done} of 12", done / 12)
        return small_card(metrics={"usual": {"fits": 12, "stretch": 0.1, "residual": 0.01}})

    monkeypatch.setattr(meshmatch, "calibrate", calibrate)
    _calibrate(Console(), tmp_path / "model", tmp_path, 1, lambda *_: None)
    begun, first, fourth, _, done = capsys.readouterr().err.splitlines()
    assert begun.startswith("fitting some of the shapes")
    assert first == "fitted 1 of 12, about 16 min left" and fourth == "fitted 4 of 12, about 12 min left"
    assert done.startswith(
        "fitted 12 of the shapes: the template is stretched 1.11-fold and lies 1 % of sqrt(area) from them"
    )
