"""How fits of two individuals differ: told from two poses of one, kept in a file that is not trusted, made of samples."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from meshmatch.errors import ModelError
from meshmatch.experiments.makers.pair_statistics import statistics_of
from meshmatch.fitting.solve.agreement import AgreeConfig, CommonStretch, as_pair, log_stretch
from meshmatch.geometry.symmetric import to_entries
from meshmatch.models import registry
from meshmatch.models.pair_statistics import PairStatistics, flat, load_pair_statistics, save_pair_statistics, unflat
from meshmatch.models.registry import add_model, load_model

from .small_model import write_model

G, K = 8, 5
RNG = np.random.default_rng(0)


def symmetric(count: int, size: float = 1.0) -> np.ndarray:
    drawn = size * np.random.default_rng(count).normal(size=(count, 3, 3))
    return drawn + drawn.transpose(0, 2, 1)


def statistics() -> PairStatistics:
    """The first direction tells individuals (100 times the variance), the second poses; of the first 0.8 are true."""
    basis = np.linalg.qr(np.random.default_rng(1).normal(size=(6 * G, K)))[0].T
    return PairStatistics(basis, np.diag([2.0, 2.0]), np.array([100.0, 1.0]), np.array([0.8, 0.2, 0.0, 0.0, 0.0]))


def test_a_vector_has_the_length_of_its_matrices() -> None:
    found = symmetric(G)
    assert np.allclose(unflat(flat(found)), found)
    assert np.linalg.norm(flat(found)) == pytest.approx(np.linalg.norm(found))
    assert flat(found).shape == (to_entries(found).size,)


def test_two_individuals_are_told_from_one() -> None:
    found = statistics()
    first, second = (unflat(row) for row in found.components[:2])
    assert found.different(0 * first) == pytest.approx(1 / 11)  # the density at 0 is a tenth
    assert found.different(5 * first) > 0.999
    assert found.different(-5 * first) == found.different(5 * first)
    assert found.different(5 * second) == pytest.approx(1 / 11)  # poses say nothing of it
    assert found.different(1e9 * first) <= 1
    assert np.allclose(found.expected(3 * first + second), 2.4 * first + 0.2 * second)


def test_what_no_two_individuals_have_is_of_no_concern() -> None:
    found = statistics()
    first, other = unflat(found.components[0]), np.tile(np.diag([1.0, 0.0, 0.0]), (G, 1, 1))
    usual = 10 * np.sqrt(2 * 1.25) / 2  # of the first: the mean square over both is 1.25
    assert found.concern(0.1 * first) == 1
    assert found.concern(0.39 * other) == 1 and 0 < found.concern(0.43 * other) < 1 and found.concern(0.47 * other) == 0
    assert found.concern(2 * usual * first) == 0


def test_statistics_come_back_from_their_file_and_with_their_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registry, "built_in_folder", lambda: tmp_path / "none")
    write_model(tmp_path / "blob")
    assert load_model(tmp_path / "blob").pairs is None
    wanted = statistics()
    save_pair_statistics(wanted, tmp_path / "blob" / registry.PAIRS, {"seed": "0"})
    model = load_model(tmp_path / "blob")
    assert model.pairs is not None
    for name, value in vars(wanted).items():
        assert np.allclose(getattr(model.pairs, name), value, atol=1e-3), name
    monkeypatch.setenv("MESHMATCH_HOME", str(tmp_path / "home"))
    assert load_model(add_model(tmp_path / "blob").folder).pairs is not None  # the copy has it too
    again = pickle.loads(pickle.dumps(model))
    assert np.array_equal(again.pairs.components, model.pairs.components)


WRONG = {
    "none at all": {},
    "an array less": {"gains": None},
    "an array more": {"else": np.zeros(2, np.float32)},
    "no numbers": {"gains": np.full(K, np.nan, np.float32)},
    "no variance": {"ratios": np.zeros(2, np.float32)},
    "another size": {"discriminant": np.eye(3, dtype=np.float32)},
    "no matrices": {"components": np.zeros((K, 6 * G + 1), np.float16)},
}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG)
def test_a_damaged_file_is_refused(tmp_path: Path, wrong: dict[str, np.ndarray | None]) -> None:
    path = tmp_path / "pairs.safetensors"
    held = {name: np.ascontiguousarray(value, np.float32) for name, value in vars(statistics()).items()} | wrong
    save_file({name: value for name, value in held.items() if value is not None and wrong}, path)
    with pytest.raises(ModelError, match="holds no statistics of pairs"):
        load_pair_statistics(path)
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(ModelError, match="damaged"):
        load_pair_statistics(path)


def test_one_individual_shares_what_two_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """The common stretch follows two fits of one; two individuals keep half of the difference that is expected."""
    found, config = statistics(), AgreeConfig(known=1.0, alike=1e9)
    first, moved = unflat(found.components[0]), np.tile(np.diag(np.exp([0.1, 0.0, 0.0])), (G, 1, 1))

    monkeypatch.setattr(PairStatistics, "concern", lambda *_: 1.0)

    def kept(size: float, pairs: PairStatistics | None = found, config: AgreeConfig = config) -> list[np.ndarray]:
        """Logarithms of the stretch that each of two keeps to, who were so far apart and now are equal."""
        logs = [0.5 * size * first, -0.5 * size * first]
        known = ([config, config],) if pairs is None else as_pair(logs, [config, config], pairs)
        priors = CommonStretch(logs, *known)([moved, moved])
        return [log_stretch(each.reference) for each in priors]  # type: ignore[attr-defined]

    one = kept(0.0)
    assert np.allclose(one[0], one[1]) and np.allclose(one[0][:, 0, 0], 0.1 * (1 - 0.4 / 11))
    two = kept(5.0)
    assert np.allclose(0.5 * (two[0] + two[1])[:, 0, 0], 0.1 * 0.6, atol=1e-4)
    assert found.components[0] @ flat(two[0] - two[1]) == pytest.approx(0.5 * 0.8 * 5)
    for unknown in (kept(5.0, None), kept(5.0, config=AgreeConfig(alike=1e9))):
        assert np.allclose(unknown[0], unknown[1]) and np.allclose(unknown[0][:, 0, 0], 0.1 * 0.4)


def test_noise_is_not_asked_who_it_is() -> None:
    config = AgreeConfig(known=1.0, schedule=AgreeConfig.schedule)
    noisy = config.for_noise(1.0)
    assert noisy.known == 0 and config.for_noise(0.5).known == 0.5
    assert noisy.between(noisy.known, 1.0) == noisy
    assert config.between(1.0, 1.0).schedule.steps == 12 and config.between(0.5, 1.0).schedule.steps == 10


def test_statistics_of_known_variations() -> None:
    """Individuals differ along one direction, poses along another; fits add noise as large as poses to the first."""
    rng, N, D = np.random.default_rng(2), 400, 6 * G
    who, how = np.linalg.qr(rng.normal(size=(D, 2)))[0].T
    person, pose = 2.0 * rng.normal(size=(N, 1, 1)), rng.normal(size=(N, 2, 1))
    true = person * who + 0.5 * pose * how + 1e-6 * rng.normal(size=(N, 2, D))
    fitted = true + rng.normal(size=(N, 2, 1)) * who
    found = statistics_of(fitted, true, 2, 2, 0)
    assert abs(found.components[0] @ who) == pytest.approx(1, abs=1e-2)
    assert found.gains[0] == pytest.approx(4 / (4 + 1), rel=0.1)  # of 2 (4 + 1) of two individuals 2 * 4 are true
    assert found.gains[1] == pytest.approx(1, rel=0.1)
    assert found.ratios.max() == pytest.approx(2 * (4 + 1) / 2, rel=0.25)
    one, two = (unflat(flat_) for flat_ in (0.2 * who, 8.0 * who))
    assert found.different(one) < 0.4 and found.different(two) > 0.99
