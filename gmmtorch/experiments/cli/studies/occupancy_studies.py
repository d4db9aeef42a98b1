"""The studies of gmmtorch-occupancy."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from omegaconf import DictConfig

from gmmtorch.cli import all_scans, build, limits, map_factory
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.events import Event, OnRows, Row
from gmmtorch.experiments.cli import methods_of_options
from gmmtorch.experiments.cli.studies.study import Found, Study
from gmmtorch.experiments.evaluation import Form, baseline, choose
from gmmtorch.experiments.report import (
    approximation_figures,
    auc_memory_figures,
    cells_figure,
    closest_look,
    map_variants_figures,
    pose_correction_figures,
    variance_threshold_figures,
)
from gmmtorch.experiments.studies import (
    BOUNDS,
    ApproximationErrorStudy,
    AucMemoryStudy,
    MapVariantsStudy,
    PoseCorrectionStudy,
    Railing,
    Sized,
    VarianceThresholdStudy,
    cells_by_setting,
    evaluate_correction,
    run_approximation_error,
    run_auc_memory,
    run_map_variants,
    run_variance_threshold,
)
from gmmtorch.mapping import METHODS, GaussianMap, MixtureRule


def _auc_memory(config: DictConfig, device: str, on_event: Event, on_rows: OnRows) -> Found:
    """Our map and the BGK map at each of their sizes, and `study.others` at their only size."""
    protocol = methods_of_options.protocol_of(config)
    study = build(AucMemoryStudy, config, "study")
    sized = [
        Sized(form, n, Form(map_factory(config, n_components=n), form))
        for form in study.forms
        for n in study.n_components
    ]
    of_runtime = limits(config)
    sized += [
        Sized("bgk_points", n, baseline("bgk_points", of_runtime, max_points=n)) for n in study.bgk_points
    ]
    if study.others:
        others = choose(study.others, methods_of_options.known_methods(config))
        sized += [Sized(name, None, factory) for name, factory in others.items()]
    for one in sized:
        methods_of_options.check_factories({one.method: one.factory}, protocol.resolution[0])
    name, scans = all_scans(config, device, on_event)
    rows = run_auc_memory(name, scans, sized, protocol, config.seed, on_event, on_rows)
    table = "method size resolution auc auc_low auc_high brier nbytes build_seconds query_seconds"
    return Found(rows, auc_memory_figures, table, f"{name}: {len(scans)} scans")


def _variance_threshold(config: DictConfig, device: str, on_event: Event, on_rows: OnRows) -> Found:
    """Thin structures with several forms, sizes, cells, priors and thresholds."""
    study = build(VarianceThresholdStudy, config, "study")
    if study.railing is None:
        (name, scans), is_thin = all_scans(config, device, on_event), None
    else:
        railing = Railing(study.railing)
        name, scans, is_thin = "railing", railing.scans(study.railing_scans, config.seed), railing.holds

    def new_map(n: int) -> GaussianMap:
        return map_factory(config, n_components=n)()

    found = run_variance_threshold(name, scans, new_map, study, config.seed, on_event, on_rows, is_thin)

    def figures(rows: list[Row]) -> dict[str, Any]:
        drawn: dict[str, Any] = dict(variance_threshold_figures(rows))
        cells = cells_by_setting(found, study)
        if found.hits.shape[1] == 3 and cells:
            thin = found.thin if len(found.thin) else found.hits
            low, high = BOUNDS if study.railing else closest_look(thin, found.hits)
            drawn["variance_threshold_cells"] = cells_figure(
                cells, found.hits, low, high, study.resolution[0]
            )
        return drawn

    table = (
        "method n_components resolution prior occupied_recall thin_recall thin_kept free_recall "
        "free_occupied auc auc_thin brier"
    )
    threshold = study.variance_threshold[0]
    shown = [row for row in found.rows if row["variance_threshold"] == threshold]
    about = f"{name}: {len(scans)} scans; variance threshold {threshold:g}"
    return Found(found.rows, figures, table, about, shown)


def _approximation_error(config: DictConfig, device: str, on_event: Event, on_rows: OnRows) -> Found:
    """Every form of evidence against the exact angular form; needs no data set."""
    study = build(ApproximationErrorStudy, config, "study")
    rows = run_approximation_error(study, config.seed, on_event, on_rows)
    swept = [row for row in rows if row["study"] == "sweep"]
    table = "method dim hits_max hits_p99 hits_median misses_max misses_p99 misses_median probability_max"
    return Found(
        rows,
        approximation_figures,
        table,
        "errors per ray of random single components",
        swept,
    )


def _pose_correction(config: DictConfig, device: str, on_event: Event, on_rows: OnRows) -> Found:
    """Maps from perturbed poses, before and after the correction of the poses."""
    protocol = methods_of_options.protocol_of(config)
    study = build(PoseCorrectionStudy, config, "study")
    new_map = map_factory(config)
    name, scans = all_scans(config, device, on_event)
    rows = evaluate_correction(name, scans, new_map, protocol, study.methods, config.seed, on_event, on_rows)
    table = "method resolution auc auc_corrected auc_clean n_components nbytes"
    return Found(rows, pose_correction_figures, table, f"{name}: {len(scans)} scans")


def _map_variants(config: DictConfig, device: str, on_event: Event, on_rows: OnRows) -> Found:
    """Maps with changed options, such as pruning."""
    protocol = methods_of_options.protocol_of(config)
    study = build(MapVariantsStudy, config, "study")
    form = next((method for method in config.method if method in METHODS), "point")
    variants = {}
    for name, changes in study.variants.items():
        if unknown := set(changes) - {*config.map, *(item.name for item in fields(MixtureRule))}:
            raise InvalidArgumentError(
                f"study.variants.{name}.{min(unknown)} is not an option of map={config.map.name}."
            )
        variants[name] = Form(map_factory(config, **changes), form)
    name, scans = all_scans(config, device, on_event)
    rows = run_map_variants(name, scans, variants, protocol, config.seed, on_event, on_rows)
    table = (
        "variant resolution n_components n_free_components nbytes auc auc_gain auc_gain_low auc_gain_high "
        "held_out_log_likelihood build_seconds"
    )
    return Found(
        rows,
        map_variants_figures,
        table,
        f"{name}: {len(scans)} scans",
        line="variant",
    )


STUDIES: dict[str, Study] = {
    "approximation_error": _approximation_error,
    "auc_memory": _auc_memory,
    "map_variants": _map_variants,
    "pose_correction": _pose_correction,
    "variance_threshold": _variance_threshold,
}
