"""Where batches are drawn: on the device that learns the same as by processes, where these are the same device."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from meshmatch.errors import OptionError
from meshmatch.generators.bodies import sample_bodies
from meshmatch.generators.characters import CharacterConfig, sample_characters
from meshmatch.generators.figure import Figure
from meshmatch.generators.generator import Source, draw_any, mix_sources, source_on, to_device
from meshmatch.models.layers import nearest_index, nearest_of_all
from meshmatch.templates.template import Template
from meshmatch.training import recipes
from meshmatch.training.batches import batches, on_device
from meshmatch.training.datasets import BatchDataset, CloudDataset, deformed_source, registered_source, step_generator
from meshmatch.training.loop import TrainConfig
from tests.generators.stick import stick_figure
from tests.training.small import SCAN, bent_eggs, egg_template, small_data, small_network

CPU, META = torch.device("cpu"), torch.device("meta")
ROUGH = replace(SCAN, outside=0.5, strays=0.5, partial=0.3, outliers=0.3)


@pytest.fixture(scope="module")
def egg() -> Template:
    return egg_template()


@pytest.fixture(scope="module")
def data(egg: Template) -> BatchDataset:
    return replace(small_data(egg, small_network(egg)), scan=ROUGH)


@pytest.fixture(scope="module")
def clouds() -> CloudDataset:
    points = torch.randn(3, 60, 3, generator=torch.Generator().manual_seed(0))
    known = torch.full((3, 2, 3), torch.nan)
    return CloudDataset(points, torch.nn.functional.normalize(points, dim=-1), known, None, None, SCAN, 4)


def eggs(egg: Template, count: int = 5) -> Tensor:
    return bent_eggs(egg)(count, torch.Generator().manual_seed(1))


def sources(egg: Template) -> dict[str, Source]:
    registered = registered_source(eggs(egg))
    return {
        "registered": registered,
        "deformed": deformed_source(eggs(egg)),
        "mixed": mix_sources(registered, partial(draw_any, 2 * eggs(egg)), 0.5),
        "anybody's": bent_eggs(egg),
    }


def held(value: Any) -> list[Tensor]:
    """Tensors of a batch, or of a source."""
    if isinstance(value, Tensor):
        return [value]
    inside = vars(value).values() if hasattr(value, "__dataclass_fields__") else value if type(value) is tuple else ()
    inside = (*value.args, *value.keywords.values()) if isinstance(value, partial) else inside
    return [tensor for each in inside for tensor in held(each)]


@pytest.mark.parametrize("name", ["registered", "deformed", "mixed", "anybody's"])
def test_a_device_draws_what_processes_draw(egg: Template, data: BatchDataset, name: str) -> None:
    data = replace(data, source=sources(egg)[name])
    found = list(batches(data, range(3, 6), CPU, 0, "device"))
    wanted = list(batches(data, range(3, 6), CPU, 0, "cpu"))
    assert len(found) == len(wanted) == 3
    for number, (a, b) in enumerate(zip(found, wanted, strict=True)):
        if name != "anybody's":  # whose shapes and scans have streams of their own
            assert all(torch.equal(x, y) for x, y in zip(held(a), held(b), strict=True))
        assert [x.shape for x in held(a)] == [x.shape for x in held(b)]
        again = next(batches(data, [3 + number], CPU, 0, "device"))
        assert all(torch.equal(x, y) for x, y in zip(held(a), held(again), strict=True))


def test_clouds_are_drawn_alike(clouds: CloudDataset) -> None:
    (found,), (wanted,) = (list(batches(clouds, [7], CPU, 0, where)) for where in ("device", "cpu"))
    assert all(torch.equal(x, y) or x.isnan().all() for x, y in zip(held(found), held(wanted), strict=True))


def test_the_usual_place(data: BatchDataset) -> None:
    """Processes, but on a GPU; and what is no dataset of ours is never drawn anywhere else."""
    usual, elsewhere = next(batches(data, [2], CPU, 0)), next(batches([data[2]], [0], CPU, 0, "device"))  # type: ignore[arg-type]
    for found in (usual, elsewhere):
        assert all(torch.equal(x, y) for x, y in zip(held(found), held(data[2]), strict=True))
    with pytest.raises(OptionError, match="drawn on auto, cpu, device, not 'gpu'"):
        TrainConfig(draw="gpu")  # type: ignore[arg-type]


@pytest.mark.parametrize("recipe", [recipes.default, recipes.people, recipes.paper])
def test_drawing_waits_for_no_number_of_the_device(
    egg: Template, data: BatchDataset, recipe: Callable[[], recipes.Recipe]
) -> None:
    """On torch's meta device, which has shapes alone: whatever asks for a value fails, and so does a tensor left behind."""
    data = replace(data, scan=recipe().scan, source=deformed_source(eggs(egg)))
    here = on_device(data, META)
    with META:
        batch = here.batch(None)
    wanted = data[0]
    assert all(x.is_meta and x.shape == y.shape for x, y in zip(held(batch), held(wanted), strict=True))
    assert not any(x.is_meta for x in held(data)) and not data.encoder.basis.is_meta  # type: ignore[union-attr]


def test_clouds_and_people_are_drawn_there_too(clouds: CloudDataset) -> None:
    there = on_device(clouds, META)
    people = source_on(partial(sample_bodies, stick_figure(3)), META)
    assert people is not None
    with META:
        batch, verts = there.batch(None), people(5, None)  # type: ignore[arg-type]
    assert all(each.is_meta for each in [*held(batch), verts]) and verts.shape == (5, *stick_figure(3).rest.shape[1:])


def test_all_of_a_source_moves(egg: Template) -> None:
    cast = partial(sample_characters, CharacterConfig(Figure.of(stick_figure(3)), 0.5))
    for source in (cast, *list(sources(egg).values())[:3]):
        there = source_on(source, META)
        assert held(there) and all(each.is_meta for each in held(there))
        assert not any(each.is_meta for each in held(source))
    assert source_on(bent_eggs(egg), META) is None
    assert source_on(partial(bent_eggs, egg), META) is None
    again = source_on(cast, CPU)
    assert again is not None and torch.equal(again(4, step_generator(0, 1)), cast(4, step_generator(0, 1)))
    assert to_device("word", META) == "word"


@pytest.mark.parametrize("D", [3, 6])
def test_all_pairs_and_trees_find_the_same(D: int, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(5, 40, D, generator=generator), torch.randn(5, 90, D, generator=generator)
    wanted = nearest_index(a, b)
    assert torch.equal(nearest_of_all(a, b), wanted)
    monkeypatch.setattr("meshmatch.models.layers._MAX_PAIRS", 40 * 90 * 2)  # three blocks
    assert torch.equal(nearest_of_all(a, b), wanted)
    assert torch.equal(
        nearest_of_all(a.bfloat16(), b.bfloat16()), nearest_index(a.bfloat16().float(), b.bfloat16().float())
    )
