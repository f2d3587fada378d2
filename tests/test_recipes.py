"""Recipes: the paper's numbers, and one line for whatever is wrong with a setting."""

from __future__ import annotations

import pytest
import yaml
from hypothesis import strategies as st

from cpunet.errors import CpunetError
from cpunet.recipes import list_recipes, load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.settings import checked


def test_the_recipe_that_trains_a_cyclegan():
    recipe = load_recipe("paper")
    generator, discriminator, training = recipe.cyclegan
    assert (generator.name, discriminator.name) == ("punet", "gru")
    assert training.losses.adversarial_weight > 0
    with pytest.raises(CpunetError, match=r"^recipe paper: does not match a response$"):
        _ = recipe.matching


def test_the_recipe_that_matches_a_response():
    recipe = load_recipe("fast")
    generator, training = recipe.matching
    assert generator.name == "response"
    assert recipe.discriminator is None
    # what is compared lies within a window, whose half maximum is before its middle
    assert training.before <= training.baseline[0] <= recipe.preparation.samples_before
    assert training.after <= recipe.preparation.samples_after
    assert -training.before <= min(training.segments)
    assert max(training.segments) <= training.after
    assert list(training.segments) == sorted(set(training.segments))
    assert training.squares <= training.components
    with pytest.raises(CpunetError, match=r"^recipe fast: does not train a CycleGAN$"):
        _ = recipe.cyclegan


def test_all_recipes_see_the_same_pulses():
    fast, *others = (load_recipe(name) for name in list_recipes())
    for other in others:
        assert (other.peaks, other.preparation) == (fast.peaks, fast.preparation)
        assert (other.cuts, other.scores) == (fast.cuts, fast.scores)


@pytest.mark.parametrize(
    ("room", "other", "said"),
    [
        ("generator", "paper", "goes with training method cyclegan"),
        ("training", "paper", "goes with training method cyclegan"),
        ("discriminator", "paper", "a discriminator is needed for punet, and for it alone"),
    ],
)
def test_parts_of_different_trainings_are_not_mixed(room, other, said):
    fast, paper = (load_recipe(name).model_dump(mode="json") for name in ("fast", other))
    for settings, part in ((fast, paper), (paper, fast)):
        with pytest.raises(CpunetError, match=f"mine: .*{said}"):
            checked(Recipe, settings | {room: part[room]}, "mine")


def test_the_papers_numbers():
    recipe = load_recipe("paper")
    training, losses = recipe.training, recipe.training.losses
    assert (training.iterations, training.decay_start, training.batch_size) == (7000, 1000, 32)
    assert (training.rate_generators, training.rate_discriminators) == (1e-3, 1e-3)
    assert (training.discriminator_interval, training.max_grad_norm) == (30, 100)
    assert (losses.baseline_len, losses.rising_edge_len, losses.tail_len) == (200, 250, 350)
    assert (losses.baseline_weight, losses.rising_edge_weight, losses.tail_weight) == (3, 10, 7)
    weights = (losses.cycle_weight, losses.identity_weight, losses.adversarial_weight)
    assert weights == (20, 5, 9)
    assert (recipe.generator.width, recipe.discriminator.embedding_rows) == (40, 1000)
    assert recipe.discriminator.samples_per_step == 1
    energies = {name: peak.energy_kev for name, peak in recipe.peaks.items()}
    # one and two annihilation photons of 511 keV (rounded) below the Tl-208 line
    assert energies["FEP"] == 2614.511
    assert energies["FEP"] - energies["SEP"] == pytest.approx(511, abs=0.01)
    assert energies["FEP"] - energies["DEP"] == pytest.approx(1022, abs=0.01)


def test_what_is_written_is_read_back():
    for name in list_recipes():
        recipe = load_recipe(name)
        text = yaml.safe_dump(recipe.model_dump(mode="json"))
        assert checked(Recipe, yaml.safe_load(text), "copy") == recipe


def test_values_are_overridden_in_turn():
    recipe = load_recipe(
        "paper",
        [
            "training.batch_size=16",
            "discriminator.value_range=[-0.1, 1.2]",
            "training.batch_size=8",
            "generator.width=8",
        ],
    )
    assert recipe.training.batch_size == 8
    assert recipe.discriminator.value_range == (-0.1, 1.2)
    assert recipe.generator.width == 8
    assert load_recipe("paper").training.batch_size == 32


def test_a_recipe_of_ones_own(tmp_path):
    path = tmp_path / "own.yaml"
    settings = load_recipe("paper").model_dump(mode="json") | {"name": "own"}
    path.write_text(yaml.safe_dump(settings))
    recipe = load_recipe(str(path), ["training.iterations=3"])
    assert (recipe.name, recipe.training.iterations) == ("own", 3)


def message(name: str, *overrides: str) -> str:
    with pytest.raises(CpunetError) as error:
        load_recipe(name, overrides)
    text = str(error.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    ("override", "part"),
    [
        (
            "training.batch_siez=16",
            "batch_siez: no such setting; did you mean batch_size?",
        ),
        ("trianing.batch_size=16", "trianing.batch_size: no such setting"),
        ("training.batch_size.more=16", "training.batch_size.more: no such setting"),
        ("training.batch_size", "expected KEY=VALUE"),
        ("=16", "expected KEY=VALUE"),
        ("training.batch_size=[", "not YAML"),
        ("training.batch_size=many", "training.batch_size: "),
        ("training.batch_size=1", "training.batch_size: "),
        ("training.batch_size=1.5", "training.batch_size: "),
        ("training.rate_generators=-1", "training.rate_generators: "),
        ("training.rate_generators=.nan", "training.rate_generators: "),
        ("training.betas=[0.5, 1.5]", "training.betas"),
        ("training.average_decay=1", "training.average_decay: "),
        ("training=5", "training: "),
        ("generator.width=3", "generator.width: "),
        ("generator.name=unet", "generator: "),
        ("generator.dropout=1", "generator.dropout: "),
        ("discriminator.value_range=[1, 0]", "discriminator: "),
        ("discriminator.value_range=[1]", "discriminator.value_range"),
        ("discriminator.samples_per_step=7", "samples_per_step (7)"),
        ("preparation.samples_before=300", "the loss windows cover 800 samples"),
        ("preparation.baseline_samples=400", "baseline_samples must be fewer"),
        ("preparation.tail_samples=401", "must fit in samples_after"),
        ("training.losses.tail_len=351", "the loss windows cover 801 samples"),
    ],
)
def test_wrong_settings_are_named(override, part):
    assert part in message("paper", override)


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("training.batch_size=16", "training.batch_size: no such setting"),
        ("training.method=cyclegan", "training"),
        ("training.method=guessing", "training: "),
        ("training.ridge=1", "training.ridge: "),
        ("training.clip=0", "training.clip: "),
        ("training.steps=0", "training.steps: "),
        ("training.start_factors=[]", "training.start_factors: "),
        ("training.segments=[0.5, 1]", "training.segments.0: "),
        ("generator.slow_ns=[100, 100.0]", "times must differ"),
        ("training.segments=[]", "training.segments: Tuple should have at least 2 items"),
        ("training.segments=[3, 1]", "segments must be in rising order"),
        ("search={a: {low: 1, choices: [1, 2]}}", "give either low and high, or choices"),
        ("search={a: {low: 1}}", "give either low and high, or choices"),
        ("training.baseline=[230]", "training.baseline"),
        ("training.search_pulses=99", "training.search_pulses: "),
        ("generator.poles_ns=[]", "generator.poles_ns: "),
        ("generator.poles_ns=[40, -1]", "generator.poles_ns.1: "),
        ("generator.ringing_mhz=0", "generator.ringing_mhz: "),
    ],
)
def test_wrong_settings_of_a_matching_are_named(override, part):
    assert part in message("fast", override)


def test_a_length_that_the_networks_cannot_halve():
    text = message("paper", "preparation.samples_after=408", "training.losses.tail_len=358")
    assert "808 samples, no multiple of 16" in text


@pytest.mark.parametrize("name", ["paper", "fast"])
def test_every_setting_is_required(name):
    settings = load_recipe(name).model_dump(mode="json")
    for room, values in settings.items():
        if isinstance(values, dict):
            for key in values:
                less = {k: v for k, v in values.items() if k != key}
                if room not in ("peaks", "search"):
                    with pytest.raises(CpunetError, match=rf"mine: {room}"):
                        checked(Recipe, settings | {room: less}, "mine")


LINE = st.text(st.characters(exclude_categories=["Cc", "Cs"]), max_size=30)
