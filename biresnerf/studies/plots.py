"""Plots of the studies: SVG for pages, PNG for everything else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.show.history import HISTORY, read_history
from biresnerf.studies.cell import RUN, Outcome
from biresnerf.studies.plan import Entry, Variant

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 6.4, 6.0  # inches
BEFORE_SWITCH, AFTER_SWITCH = 0.75, 1.5  # steps shown in the plot of the warm-up, as factors of the switch


def _figure(rows: int, columns: int = 1) -> tuple[Figure, Any]:
    import matplotlib

    matplotlib.use("Agg")
    # Keep text as text, and ids reproducible.
    matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "biresnerf", "font.size": 10})
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        rows, columns, figsize=(WIDTH, HEIGHT * rows / 2), squeeze=False, layout="constrained"
    )
    return figure, axes


def _save(figure: Figure, folder: Path, name: str) -> list[Path]:
    import matplotlib.pyplot as plt

    paths = [folder / f"{name}.svg", folder / f"{name}.png"]
    for path in paths:
        with whole_file(path) as temporary:
            figure.savefig(temporary, dpi=120, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)
    return paths


def _line_with_range(
    axes: Axes, points: Sequence[tuple[float, list[float]]], label: str, **style: Any
) -> None:
    """Means over the seeds, with a band from minimum to maximum."""
    known = [(x, values) for x, values in points if values]
    if not known:
        return
    x = [at for at, _ in known]
    (line,) = axes.plot(x, [np.mean(v) for _, v in known], marker="o", markersize=4, label=label, **style)
    axes.fill_between(
        x, [min(v) for _, v in known], [max(v) for _, v in known], color=line.get_color(), alpha=0.15, lw=0
    )


def plot_sweep(
    entries: Sequence[Entry], variants: Sequence[Variant], option: str, about: str, folder: Path, name: str
) -> list[Path]:
    """Rotation error and PSNR against the value of an option, a line for each scene."""
    figure, axes = _figure(2)
    rotation, quality = axes[0][0], axes[1][0]
    for scene in dict.fromkeys(entry.scene for entry in entries):
        errors, decibels = [], []
        for variant in variants:
            outcomes = _outcomes(entries, scene=scene, variant=variant.name)
            value = float(variant.settings[option])
            errors.append((value, [o.after.aligned.rotation_deg.mean for o in outcomes]))
            decibels.append((value, [o.views.psnr for o in outcomes if o.views is not None]))
        _line_with_range(rotation, errors, scene)
        _line_with_range(quality, decibels, scene)
    rotation.set(ylabel="rotation error (°)", yscale="log")
    quality.set(ylabel="PSNR of unseen views (dB)", xlabel=about)
    for panel in (rotation, quality):
        panel.set_xscale("log", base=2)
        ticks = [float(variant.settings[option]) for variant in variants]
        panel.set_xticks(ticks, [f"{tick:g}" for tick in ticks], fontsize=8)
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    rotation.legend()
    return _save(figure, folder, name)


def plot_noise(entries: Sequence[Entry], about: str, folder: Path, name: str) -> list[Path]:
    """Rotation error after against the noise before, a panel for each scene and a line for each variant."""
    scenes = list(dict.fromkeys(entry.scene for entry in entries))
    figure, axes = _figure(len(scenes))
    for panel, scene in zip(axes[:, 0], scenes, strict=True):
        noises = sorted({entry.start.noise for entry in entries if entry.scene == scene})
        start = [(noise, _outcomes(entries, scene=scene, noise=noise)) for noise in noises]
        before = [(noise, [o.before.aligned.rotation_deg.mean for o in found]) for noise, found in start]
        _line_with_range(panel, before, "start", color="0.5", linestyle=":")
        for variant in dict.fromkeys(entry.variant for entry in entries):
            points = [
                (noise, _outcomes(entries, scene=scene, variant=variant, noise=noise)) for noise in noises
            ]
            after = [(noise, [o.after.aligned.rotation_deg.mean for o in found]) for noise, found in points]
            _line_with_range(panel, after, variant)
        panel.set(yscale="log", ylabel="rotation error (°)", xlabel=about, title=scene)
        panel.grid(alpha=0.3)
        panel.legend()
    return _save(figure, folder, name)


def plot_curves(entries: Sequence[Entry], cells: Path, folder: Path, name: str) -> list[Path]:
    """Training PSNR and rotation error over the steps around the switch, a line for each variant and run."""
    figure, axes = _figure(2)
    training, rotation = axes[0][0], axes[1][0]
    scenes = len({entry.scene for entry in entries})
    switches = []
    for number, variant in enumerate(dict.fromkeys(entry.variant for entry in entries)):
        for entry in entries:
            outcome = entry.result.outcome
            if entry.variant != variant or outcome is None or outcome.switch_step is None:
                continue
            switch = outcome.switch_step
            switches.append(switch)
            lines = read_history(cells / entry.result.cell.folder_name / RUN / HISTORY)
            shown = [
                line
                for line in lines
                if BEFORE_SWITCH * switch <= float(line["step"]) <= AFTER_SWITCH * switch
            ]
            steps = [float(line["step"]) for line in shown]
            label = f"{entry.scene}, {variant}" if scenes > 1 else variant
            style: dict[str, Any] = {"color": f"C{number}", "lw": 1, "label": label}
            training.plot(steps, [float(line["psnr"]) for line in shown], **style)
            rotation.plot(steps, [float(line["rotation_deg"]) for line in shown], **style)
    for panel in (training, rotation):
        for switch in sorted(set(switches)):
            panel.axvline(switch, color="0.5", linestyle=":", lw=1)
        panel.grid(alpha=0.3)
    training.set(ylabel="training PSNR (dB)")
    rotation.set(ylabel="rotation error (°)", xlabel="step (dotted: stage 2 begins)", yscale="log")
    handles, labels = training.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    training.legend(list(unique.values()), list(unique))
    return _save(figure, folder, name)


def _outcomes(
    entries: Sequence[Entry], *, scene: str, variant: str | None = None, noise: float | None = None
) -> list[Outcome]:
    return [
        entry.result.outcome
        for entry in entries
        if entry.result.outcome is not None
        and entry.scene == scene
        and variant in (None, entry.variant)
        and noise in (None, entry.start.noise)
    ]
