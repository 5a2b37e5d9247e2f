"""Which cells a plan asks for, what makes two of them one, and how long a run at equal time is."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from biresnerf.errors import InputError
from biresnerf.options.presets import MethodName
from biresnerf.options.refine_options import RefineOptions
from biresnerf.studies.cell import Cell, CellResult, Perturbation
from biresnerf.studies.plan import Plan, Variant, run_plan, with_steps
from biresnerf.studies.studies import STUDIES
from tests.studies.outcomes import outcome, scene

FAST = {"preset": "fast"}


def plan(*variants: Variant, settings=FAST, equal_time=False, seeds=(1, 2)) -> Plan:
    starts = tuple(Perturbation(seed=seed) for seed in seeds)
    return Plan((scene("lego"), scene("ship")), starts, variants, settings, equal_time)


def cell(**changed) -> Cell:
    values = {"scene": scene(), "start": Perturbation(), "options": RefineOptions(**FAST)}
    return Cell(**{**values, **changed})


def test_every_scene_start_and_variant_is_run_once_and_the_seed_is_the_runs_too():
    asked = []

    def run(wanted: Cell, title: str) -> CellResult:
        asked.append((wanted.scene.name, wanted.options.seed, wanted.options.pose_rate, title))
        return CellResult(cell=wanted, outcome=outcome(0.01))

    entries = run_plan(plan(Variant("a", {}), Variant("b", {"pose_rate": 0.01})), run)
    assert len({entry.result.cell.key for entry in entries}) == len(asked) == 8
    assert asked[1] == ("lego", 1, 0.01, "lego, noise 0.15, seed 1: b")
    assert [(e.scene, e.start.seed, e.variant) for e in entries][-1] == ("ship", 2, "b")


def test_a_key_is_of_what_decides_the_result():
    same = cell(scene=scene().model_copy(update={"file": Path("elsewhere.json")}))
    assert cell().key == same.key
    assert cell().key == cell(options=RefineOptions(preset="fast", pose_rate=5e-3)).key  # the preset's own
    others = [
        cell(start=Perturbation(seed=2)),
        cell(start=Perturbation(noise=0.1)),
        cell(options=RefineOptions(preset="fast", pose_rate=1e-3)),
        cell(scene=scene("other poses")),
        cell(scene=scene().model_copy(update={"every": 2})),
    ]
    assert len({cell().key, *(other.key for other in others)}) == 6


def test_a_change_of_the_method_makes_another_cell_and_reaches_it_by_name():
    made = plan(
        Variant("whole", {}), Variant("no repair", {"method.repair": False, "pose_rate": 0.01}),
        settings={**FAST, "method.by_detail": 0}, seeds=(1,),
    )  # fmt: skip
    cells: list[Cell] = []
    run_plan(
        made, lambda wanted, _title: cells.append(wanted) or CellResult(cell=wanted, outcome=outcome(0.01))
    )
    assert [each.method for each in cells[:2]] == [{"by_detail": 0}, {"by_detail": 0, "repair": False}]
    assert [each.options.pose_rate for each in cells[:2]] == [None, 0.01]
    assert cell(method={"repair": False}).key != cell().key
    with pytest.raises(InputError, match="no field of the method"):
        plan(Variant("wrong", {"method.repairs": False})).options(
            Variant("wrong", {"method.repairs": False}), scene(), Perturbation()
        )


def test_a_scene_with_test_views_has_all_others_optimised():
    tested = scene().model_copy(update={"test_file": Path("transforms_test.json"), "test_views": 5})
    made = plan(Variant("a", {}))
    assert made.options(made.variants[0], tested, Perturbation()).holdout == 0
    assert made.options(made.variants[0], scene(), Perturbation()).holdout is None


def test_runs_start_from_the_wrong_poses_themselves_unless_a_variant_says_otherwise():
    made = plan(Variant("a", {}), Variant("matches", {"start": "auto"}))
    starts = [made.options(variant, scene(), Perturbation()).start for variant in made.variants]
    assert starts == ["given", "auto"]


def test_a_variant_with_an_unknown_option_is_refused():
    with pytest.raises(InputError, match="stepz: unknown option"):
        plan(Variant("a", {"stepz": 1})).options(Variant("a", {"stepz": 1}), scene(), Perturbation())


@pytest.mark.parametrize(("ms", "measured", "fitting"), [(8.0, [20, 75], 750), (300.0, [20], 20)])
def test_at_equal_time_the_others_get_the_steps_that_fit_the_firsts_time(ms, measured, fitting):
    asked = []

    def run(wanted: Cell, title: str) -> CellResult:
        # The first takes 2 ms a step.
        steps = wanted.options.resolved("cpu").steps
        asked.append(steps)
        each = 2.0 if wanted.options.pose_rate is None else ms
        return CellResult(cell=wanted, outcome=outcome(0.01, seconds=each * steps / 1000))

    variants = (Variant("a", {}), Variant("b", {"pose_rate": 0.01}))
    one_scene = Plan((scene(),), (Perturbation(),), variants, FAST, equal_time=True)
    entries = run_plan(one_scene, run)
    first, other = entries[0].result.cell, entries[1].result.cell
    assert asked == [3000, *measured, fitting]
    assert first.equal_time is None
    assert other.options.steps == fitting  # 6 s at so many ms
    assert other.equal_time.calibration_steps == measured[-1]
    assert other.equal_time.calibration_ms_per_step == pytest.approx(ms)
    assert other.equal_time.seconds == pytest.approx(6.0)


def test_without_a_first_result_there_is_no_time_to_equal():
    entries = run_plan(
        plan(Variant("a", {}), Variant("b", {}), equal_time=True, seeds=(1,)),
        lambda wanted, _: CellResult(cell=wanted, error="exit status 1"),
    )
    assert "the first variant failed" in entries[1].result.error


def test_a_shorter_run_keeps_its_proportions_even_where_they_were_set():
    options = RefineOptions(
        preset="fast", steps=2000, coarse_steps_min=500, coarse_steps_max=1000, check_every=100
    )
    short = with_steps(options, 200)
    assert (short.steps, short.coarse_steps_min, short.coarse_steps_max, short.check_every) == (
        200,
        50,
        100,
        10,
    )


@pytest.mark.parametrize("method", get_args(MethodName))
def test_every_method_is_a_variant_that_can_be_shortened(method):
    options = plan().options(Variant(method, {"method": method}), scene(), Perturbation())
    assert options.method == method
    assert with_steps(options, 300).resolved("cpu").steps == 300


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_has_options_that_can_be_run(name):
    study = STUDIES[name]
    made = plan(*study.variants, settings=study.settings({"preset": "fast", "steps": 600}))
    for variant in study.variants:
        options = made.options(variant, scene(), Perturbation()).resolved("cpu")
        assert options.steps == 600
        if study.swept:
            assert options.coarse_steps_min == options.coarse_steps_max == 600
            assert getattr(options, study.swept) == variant.settings[study.swept]
    if name == "warm-up":
        assert len({made.options(v, scene(), Perturbation()).coarse_steps_min for v in study.variants}) == 1
