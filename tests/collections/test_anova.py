"""Analysis of variance of shapes against a plain reference, by chance, and with effects that are known."""

from __future__ import annotations

import numpy as np
import pytest

from meshmatch.collections.anova import Variances, analyse
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.covariates import DesignTerm
from meshmatch.collections.explain import Explained
from meshmatch.collections.permutation import orders
from meshmatch.errors import InputError, OptionError
from tests.collections.ellipsoids import AXES, ellipsoids

POLE = int(ellipsoids(1).points[0, :, 2].argmax())
NORMALS = np.tile([0.0, 0.6, 0.8], (5, 1))


def hat(*columns: np.ndarray) -> np.ndarray:
    """The projection onto columns and the mean."""
    given = np.column_stack([np.ones(len(columns[0])), *columns]) if columns else np.ones((S, 1))
    return given @ np.linalg.pinv(given)


S = 14
RANDOM = np.random.default_rng(3)
NUMBER = RANDOM.standard_normal(S)
KIND = np.eye(3)[np.arange(S) % 3][:, 1:]
TERMS = [
    DesignTerm("number", NUMBER[:, None], ("number",)),
    DesignTerm("kind", KIND, ("kind: b - a", "kind: c - a")),
    DesignTerm("number:kind", NUMBER[:, None] * KIND, ("number:b", "number:c")),
]


def reference(values: np.ndarray, order: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Sequential sum of squares of each term, and F of each permutation, of values (S, D), by definition."""
    columns: list[np.ndarray] = []
    every = [term.columns for term in TERMS]
    whole = hat(*every)
    rest = S - round(np.trace(whole))
    found = []
    for term in TERMS:
        before = hat(*columns)
        columns.append(term.columns)
        behind = hat(*columns)
        df = round(np.trace(behind) - np.trace(before))
        left = values - before @ values
        ratios = []
        for row in order:
            made = before @ values + left[row]
            explained = np.square((behind - before) @ made).sum()
            ratios.append(explained / df / (np.square(made - whole @ made).sum() / rest))
        found.append((float(np.square((behind - before) @ values).sum()), np.array(ratios)))
    return found


def effect_size(values: np.ndarray) -> float:
    """By trying powers."""

    def unlikely(power: float) -> float:
        changed = (values**power - 1) / power
        return len(values) / 2 * np.log(changed.var()) - (power - 1) * np.log(values).sum()

    power = min(np.linspace(-2, 2, 800), key=unlikely)
    changed = (values**power - 1) / power
    return (changed[0] - changed.mean()) / changed.std()


def offsets_of(random: np.random.Generator) -> np.ndarray:
    return random.standard_normal((S, 5, 3))


def analysed(offsets: np.ndarray, terms=TERMS, **options) -> Variances:
    return analyse(offsets.reshape(len(offsets), -1), offsets, terms, NORMALS, **options)


def test_the_table_is_that_of_geomorph() -> None:
    """Centroid sizes of ten axes by their makers' mark, by geomorph 3.3.1 with 10,000 permutations (R. Z. Selden, supplement
    of "French trade axe morphology differs by makers' mark", 2021). Of the 120 labellings, 4 have an F as large, theirs
    among them."""
    size = [447.6635, 499.3537, 421.9203, 502.4541, 444.6668, 442.0828, 468.6789, 471.1334, 419.2457, 420.7324]
    mark = DesignTerm("mark", np.array([0, 0, 1, 0, 1, 1, 1, 1, 1, 1.0])[:, None], ("DG",))
    points = np.array(size)[:, None]
    offsets = np.pad(points[:, None], ((0, 0), (0, 0), (0, 2)))
    found = analyse(points, offsets, [mark], np.array([[1.0, 0, 0]]), permutations=9999)
    effect = found.effects[0]
    assert (effect.df, found.residual_df, found.total_df) == (1, 8, 9)
    ours = effect.ss, effect.ms, found.residual_ss, found.residual_ss / 8, found.total_ss
    assert ours == pytest.approx((3695.3, 3695.3, 4831.0, 603.9, 8526.3), abs=0.05)
    assert (effect.r2, effect.f) == pytest.approx((0.4334, 6.1193), abs=5e-5)
    assert effect.z == pytest.approx(1.6529, abs=0.1) and effect.p == pytest.approx(
        4 / 120, abs=0.006
    )  # theirs: 0.0252


@pytest.mark.parametrize("along", [True, False])
def test_the_table_is_that_of_a_plain_reference(along) -> None:
    offsets = offsets_of(RANDOM)
    offsets += NUMBER[:, None, None] * RANDOM.standard_normal((5, 3))
    order, exact = orders(np.zeros(S, np.int64), 120, 5)
    assert not exact
    found = analysed(offsets, along=along, permutations=120, seed=5)
    flat = offsets.reshape(S, -1)
    assert (found.permutations, found.exact, found.residual_df, found.total_df) == (121, False, 8, 13)
    assert found.total_ss == pytest.approx(np.square(flat - flat.mean(axis=0)).sum())
    assert found.residual_ss + sum(effect.ss for effect in found.effects) == pytest.approx(found.total_ss)
    along_normals = np.einsum("svi,vi->sv", offsets, NORMALS)
    # The program permutes columns of the model, the reference residuals: in an order and its inverse.
    inverse = np.argsort(order, axis=1)
    largest = [np.stack([reference(along_normals[:, [v]], inverse)[k][1] for v in range(5)]) for k in range(3)]
    for k, (effect, (ss, ratios)) in enumerate(zip(found.effects, reference(flat, inverse), strict=True)):
        assert effect.df == (1, 2, 2)[k]
        assert effect.ss == pytest.approx(ss)
        assert effect.r2 == pytest.approx(ss / found.total_ss)
        assert effect.f == pytest.approx(ratios[0])
        assert effect.p == pytest.approx(np.mean(ratios >= ratios[0] * (1 - 1e-9)))
        assert effect.z == pytest.approx(effect_size(ratios), abs=0.01)
        if along:
            own, most = largest[k][:, :1], largest[k].max(axis=0)
            assert effect.places.statistic == pytest.approx(own[:, 0])
            assert effect.places.p == pytest.approx((largest[k] >= own * (1 - 1e-9)).mean(axis=1))
            assert effect.places.p_corrected == pytest.approx((most >= own * (1 - 1e-9)).mean(axis=1))
            assert effect.p_anywhere == effect.places.p_corrected.min()
    both = np.column_stack([np.ones(S), NUMBER, KIND])
    assert found.effects[1].change == pytest.approx(np.tensordot(np.linalg.pinv(both)[2:], offsets, 1))


def test_two_groups_are_compared_as_ever() -> None:
    """A model of one column of two categories is Hotelling's test."""
    given = ellipsoids(9)
    points = given.points + 0.05 * RANDOM.standard_normal(given.points.shape)
    atlas = Atlas.of(points, given.faces)
    sex = ["a"] * 4 + ["b"] * 5
    for kind in ("normal", "hotelling"):
        groups = atlas.compare(atlas.names[:4], atlas.names[4:], kind=kind)
        model = atlas.anova("form ~ sex", {"sex": sex}, kind=kind, permutations=2000).table.effects[0]
        assert model.along_normal[0] == pytest.approx(groups.along_normal)
        if kind == "normal":
            assert model.places.statistic == pytest.approx(groups.statistic)
        assert np.array_equal(np.argsort(model.places.statistic), np.argsort(groups.statistic))
        assert model.places.p == pytest.approx(groups.p, abs=0.06)
        assert model.p == pytest.approx(groups.p_overall, abs=0.05)


def test_chance_is_taken_for_chance() -> None:
    """With a covariate that matters a lot, and with pairs that differ."""
    random = np.random.default_rng(7)
    hits = np.zeros(4)
    kind = [TERMS[0], DesignTerm("split", (np.arange(S)[:, None] % 2).astype(float), ("split",))]
    pairs = np.arange(S) // 2
    subjects = DesignTerm("subject", np.eye(7)[pairs][:, 1:], tuple(map(str, range(6))))
    for seed in range(200):
        offsets = offsets_of(random)
        plain = analysed(offsets + 5 * NUMBER[:, None, None], kind, permutations=99, seed=seed).effects[1]
        offsets += 5 * random.standard_normal((7, 1, 3))[pairs]
        paired = analysed(offsets, [subjects, kind[1]], blocks=pairs, permutations=200)
        assert paired.exact
        assert paired.permutations == 128
        assert np.isnan(paired.effects[0].p)
        assert paired.effects[0].places is None
        hits += [
            each <= 0.05 for each in (plain.p, plain.p_anywhere, paired.effects[1].p, paired.effects[1].p_anywhere)
        ]
    assert (hits <= 20).all()
    assert (hits >= 2).all()


def test_pairs_are_sign_flips() -> None:
    """The paired test by its definition: all signs of the differences."""
    offsets = offsets_of(RANDOM)
    offsets[1::2] += 0.5
    pairs = np.arange(S) // 2
    terms = [
        DesignTerm("subject", np.eye(7)[pairs][:, 1:], tuple(map(str, range(6)))),
        DesignTerm("after", (np.arange(S)[:, None] % 2).astype(float), ("after",)),
    ]
    found = analysed(offsets, terms, blocks=pairs).effects[1]
    apart = (offsets[1::2] - offsets[::2]).reshape(7, -1)
    signs = np.array(np.meshgrid(*[[1, -1]] * 7)).reshape(7, -1).T
    means = np.square(signs @ apart / 7).sum(axis=1)
    assert found.p == pytest.approx(np.mean(means >= means[0] * (1 - 1e-9)))
    assert found.change[0].ravel() == pytest.approx(apart.mean(axis=0))


@pytest.fixture(scope="module")
def planted() -> tuple[Explained, np.ndarray]:
    """Eggs that are flatter the larger they are, with a bump on every second."""
    given = ellipsoids(24, spread=np.array([0.02, 0.02, 0.02]))
    random = np.random.default_rng(2)
    points = given.points + 0.01 * random.standard_normal(given.points.shape)
    size = random.uniform(0.8, 1.25, 24)
    points[:, :, 2] *= (size**0.3)[:, None]
    bump = np.exp(-10 * np.square(given.points[0] / given.axes[0] - [1, 0, 0]).sum(axis=1))
    points[1::2, :, 0] += 0.2 * bump
    atlas = Atlas.of(points * size[:, None, None], given.faces, scale="remove")
    table = {"name": atlas.names[::-1], "kind": ["bump", "none"] * 12, "age": random.uniform(20, 60, 24).tolist()}
    return atlas.anova("shape ~ log(size) + kind + age", table, permutations=499, seed=1), bump


def test_effects_are_found_where_they_are(planted: tuple[Explained, np.ndarray]) -> None:
    found, bump = planted
    size, kind, age = found.table.effects
    assert found.columns["kind"] == "2 categories (bump 12, none 12), compared with bump"
    assert size.p == kind.p_anywhere == 1 / 500
    assert age.p_anywhere > 0.05
    assert kind.along_normal[0, bump.argmax()] == pytest.approx(-0.2, rel=0.15)
    assert kind.places.p_corrected[bump.argmax()] == 1 / 500
    assert (kind.places.p_corrected[bump < 0.01] > 0.05).mean() > 0.9
    assert size.z > 2
    share = AXES[2] ** 2 / np.square(AXES).sum()  # of the size that is removed
    assert size.along_normal[0, POLE] == pytest.approx(0.3 * (1 - share) * AXES[2], rel=0.15)


def test_shape_goes_with_size(planted: tuple[Explained, np.ndarray]) -> None:
    about = planted[0].allometry
    assert about is not None
    assert about.label == "log(size)"
    for scores in (about.cac, about.regression_scores):
        assert np.corrcoef(scores, about.sizes)[0, 1] > 0.9
    assert abs(np.corrcoef(about.residual, np.array(planted[0].groups) == "bump")[0, 1]) > 0.7
    assert np.abs(about.axis[POLE]).argmax() == 2


def test_common_allometry_is_that_within_groups() -> None:
    """Scores are those of a plain reference, where one group is larger and has a bump."""
    given = ellipsoids(20, splits=1, spread=np.array([0.02, 0.02, 0.02]))
    random = np.random.default_rng(5)
    size = np.concatenate([random.uniform(0.8, 1.0, 10), random.uniform(1.1, 1.4, 10)])
    points = given.points + 0.005 * random.standard_normal(given.points.shape)
    points[:, :, 2] *= (size**0.3)[:, None]
    bump = np.exp(-10 * np.square(given.points[0] / given.axes[0] - [1, 0, 0]).sum(axis=1))
    points[10:, :, 0] += 0.3 * bump
    atlas = Atlas.of(points * size[:, None, None], given.faces, scale="remove")
    kind = np.repeat([0, 1], 10)
    found = atlas.anova("shape ~ log(size) + kind", {"kind": ["ab"[k] for k in kind]}, permutations=9).allometry
    assert found is not None
    flat = (atlas.offsets(atlas.scores) * np.sqrt(atlas.weights)[:, None]).reshape(20, -1)
    x = np.log(atlas.sizes)
    within = np.eye(20) - np.where(kind[:, None] == kind, 0.1, 0.0)
    common = (within @ x) @ flat
    alone = (x - x.mean()) @ flat
    assert found.cac == pytest.approx(flat @ common / np.linalg.norm(common))
    assert found.regression_scores == pytest.approx(flat @ alone / np.linalg.norm(alone))


def test_what_cannot_be_explained() -> None:
    given = ellipsoids(6)
    atlas = Atlas.of(given.points, given.faces)
    ages = {"age": [1, 2, 3, 4, 5, 6], "twice": [2, 4, 6, 8, 10, 12], "id": list("abcdef"), "x": list("aabbaa")}
    refused: dict[str, tuple[type[Exception], str]] = {
        "form ~ age + twice": (InputError, "twice adds nothing to the terms before it"),
        "form ~ id": (InputError, "too few"),
        "form ~ age*x + log(age) + log(twice)": (InputError, "too few"),
        "shape ~ age": (OptionError, "keeps the shapes' sizes"),
    }
    for formula, (kind, words) in refused.items():
        with pytest.raises(kind, match=words):
            atlas.anova(formula, ages)
    with pytest.raises(OptionError, match="statistic"):
        atlas.anova("form ~ age", ages, kind="welch")  # type: ignore[arg-type]
    for count, words in ((0, "at least one permutation"), (2.5, "must be a whole number, not 2.5")):
        with pytest.raises(OptionError, match=words):
            atlas.anova("form ~ age", ages, permutations=count)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="too many"):
        orders(np.zeros(40, np.int64), 10**9, 0)


def test_blocks_that_exchange_nothing_are_refused() -> None:
    given = ellipsoids(6)
    atlas = Atlas.of(given.points, given.faces)
    table = {"x": list("aabbaa"), "id": list("aabbcc"), "own": list("abcdef")}
    for formula, blocks in (("form ~ x", "id"), ("form ~ id", "id"), ("form ~ x", "own")):
        with pytest.raises(InputError, match="nothing to exchange"):
            atlas.anova(formula, table, blocks=blocks)
    with pytest.raises(InputError, match="no column called subject"):
        atlas.anova("form ~ x", table, blocks="subject")
