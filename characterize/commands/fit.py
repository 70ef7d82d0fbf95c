"""Bench captures -> the lens (or the pupil) that made them, with intervals,
degeneracies and a report.

An interruption leaves what stood at the output; the same command begins the fit
(minutes) anew, but for its pillars,
which are kept in the cache folder of the user.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

from characterize import next_mask
from characterize.bench import HiddenLens
from characterize.captures import capture as captures
from characterize.commands import report
from characterize.commands.fit_options import Options
from characterize.inference import AsBuilt, fit
from characterize.inference import FitOptions as FitOptions
from characterize.model import KnownValue
from characterize.pupil import PupilFit, PupilSpec, fit_pupil, save_pupil
from metalens import lens as lenses
from metalens.core import config, store
from metalens.core.errors import ConfigError

# endings of the files of a correction
NEXT_MASK = ("_bias.csv", "_bias.toml", "_lens_corrected.h5")


@dataclass(frozen=True)
class MetrologySettings:
    """TOML of what was measured otherwise (``[[known]]`` tables of name, value, sigma),
    and of how to fit.

    known: what was measured otherwise. free: further parameters to fit, by name.
    window: pixels along a side that are
    fitted. scan_um: half of the range in which the zero of the stage is looked for;
    left out: chosen from the depths.
    """

    known: tuple[KnownValue, ...] = ()
    free: tuple[str, ...] = ()
    window: int = field(default=48, metadata={"above": 0})
    scan_um: float | None = field(default=None, metadata={"above": 0})


def run(options: Options) -> int:
    """Fit; exit 0 when all checks passed, 1 when a result fails its own checks.

    Args:
        options: options of the command.
    """
    target = options.output
    if target.suffix != ".h5":
        raise ConfigError(f"{target}: need a name that ends in .h5")
    if (options.design is None) == (options.pupil is None):
        raise ConfigError(
            "give either --design lens.h5 (a metalens) or --pupil pupil.toml (any other lens)"
        )
    if options.truth is not None and options.pupil is not None:
        raise ConfigError(
            "--truth is of a virtual bench of a metalens: it goes with --design, not with --pupil"
        )
    if options.pupil is not None and options.next_mask:
        raise ConfigError("--next-mask goes with --design, not with --pupil")
    if options.process is not None and not options.next_mask:
        raise ConfigError("--process is of the present mask: give --next-mask too")
    if options.pupil is not None:
        return _run_pupil(options, options.pupil, target)
    return _run_lens(options, options.design or Path(), target)


def _run_lens(options: Options, design: Path, target: Path) -> int:
    """Fit an as-built lens, write it with its page, print; the exit status."""
    lens = lenses.load(design)
    capture = captures.load(options.capture)
    metrology = (
        config.load(options.metrology, MetrologySettings)
        if options.metrology
        else MetrologySettings()
    )
    choice = FitOptions(
        metrology.free,
        metrology.known,
        metrology.window,
        metrology.scan_um,
        insist=options.insist,
    )
    truth = config.load(options.truth, HiddenLens) if options.truth else None
    true_values = {k.name: k.value for k in truth.parameter} if truth else None
    present_bias = next_mask.present_bias(options.process)
    provenance = _provenance(options, design)
    with options.claim(
        target, companions=report.COMPANIONS + (NEXT_MASK if options.next_mask else ())
    ) as draft:
        result = dataclasses.replace(fit(capture, lens, choice), provenance=provenance)
        result.save(draft.path)
        report.asbuilt_report(
            draft.path.with_suffix(".html"), result, truth=true_values
        )
        mask = None
        if options.next_mask:
            mask = next_mask.plan_next_mask(result, old=present_bias)
            if not mask.refused:
                next_mask.write_correction(
                    draft.path.parent,
                    mask.plan,
                    evened=not mask.uneven,
                    prefix=f"{draft.path.stem}_",
                )
    values, text = _lens_values(result), _lens_text(result, target)
    if mask is None:
        return options.console.judged(values, text, result.problems)
    strehl = {step.name: step.strehl for step in mask.steps}
    values["next_mask"] = {"summary": mask.summary, "strehl": strehl}
    if not mask.refused:
        text = f"{text}\n  next mask: {mask.summary}"
    return options.console.judged(values, text, [*result.problems, mask.refused])


def _run_pupil(options: Options, pupil: Path, target: Path) -> int:
    """Fit a pupil, write it with its page, print; the exit status."""
    spec = config.load(pupil, PupilSpec)
    if spec.mask is not None:
        spec = dataclasses.replace(spec, mask=pupil.parent / spec.mask)
    capture = captures.load(options.capture)
    provenance = _provenance(options, pupil, *([spec.mask] if spec.mask else []))
    with options.claim(target, companions=report.COMPANIONS) as draft:
        pupil_fit = fit_pupil(capture, spec, insist=options.insist)
        save_pupil(draft.path, pupil_fit, provenance)
        report.pupil_report(draft.path.with_suffix(".html"), pupil_fit)
    return options.console.judged(
        _values(pupil_fit), _text(pupil_fit, target), pupil_fit.problems
    )


def _provenance(options: Options, *sources: Path) -> store.Provenance:
    """Settings as text, and the SHA-256 of every capture file, source and settings
    file by name.
    """
    path = options.capture
    files = (
        sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    )
    files += [*sources] + ([options.metrology] if options.metrology else [])
    texts = [
        p.read_text(encoding="utf-8")
        for p in (options.pupil, options.metrology)
        if p is not None
    ]
    return store.Provenance(
        config="\n".join(texts), inputs={p.name: store.sha256(p) for p in files}
    )


def _lens_values(result: AsBuilt) -> dict[str, object]:
    """Numbers of an as-built fit for JSON: parameters, intervals, chi², verdicts."""
    rows = zip(result.names, result.value, result.sigma, strict=True)
    words = {
        name: list(getattr(result, name))
        for name in ("verdicts", "identifiable", "degeneracies", "cautions", "problems")
    }
    return {
        "parameters": {name: [float(v), float(s)] for name, v, s in rows},
        "intervals": {name: list(result.interval(name)) for name in result.names},
        "intervals_within_model": {
            name: list(result.within_model(name)) for name in result.names
        },
        "chi2_per_dof": result.chi2_per_dof,
        "converged": result.converged,
        "reason": result.reason,
        **words,
    }


def _lens_text(result: AsBuilt, target: Path) -> str:
    """Text of an as-built fit for the console: verdicts, table of parameters, notes."""
    lines = [
        f"{target}: fitted to {len(result.measured)} frames, chi² / dof {result.chi2_per_dof:.3f}; {result.reason}"
    ]
    lines += [f"  {words}" for words in result.verdicts]
    lines.append(
        f"  {'parameter':<24} {'value':>10}   {'total 95 %':<24} statistical 95 %"
    )
    for name, v in zip(result.names, result.value, strict=True):
        total, statistical = (
            f"{low:.4g} to {high:.4g}"
            for low, high in (result.interval(name), result.within_model(name))
        )
        widened = ", ".join(result.most(name))
        row = f"  {name:<24} {v:10.4g}   {total:<24} {statistical:<24}"
        lines.append((f"{row} widened by {widened}" if widened else row).rstrip())
    for label, words in (
        ("cannot tell", result.degeneracies),
        ("note", result.cautions),
    ):
        lines += [f"  {label}: {text}" for text in words]
    return "\n".join(lines)


def _values(pupil_fit: PupilFit) -> dict[str, object]:
    """Numbers of a pupil fit for JSON: agreement, chi², optics, parameters, cautions."""
    scores = {"agreement": pupil_fit.agreement, "held_out": pupil_fit.held_out}
    return {
        **{
            key: dataclasses.asdict(score)
            for key, score in scores.items()
            if score is not None
        },
        "chi2_per_dof": pupil_fit.chi2_per_dof,
        "converged": pupil_fit.converged,
        "reason": pupil_fit.reason,
        "optics": {name: [value, sigma] for name, value, sigma in pupil_fit.optics},
        "parameters": {
            n: [float(v), float(s)]
            for n, v, s in zip(
                pupil_fit.names, pupil_fit.value, pupil_fit.sigma, strict=True
            )
        },
        "cautions": list(pupil_fit.cautions),
        "problems": list(pupil_fit.problems),
    }


def _text(pupil: PupilFit, target: Path) -> str:
    """Text of a pupil fit for the console: agreement, first 12 parameters, notes."""
    lines = [f"{target}: pupil fitted to {len(pupil.measured)} planes; {pupil.reason}"]
    scores = (
        ("all planes fitted", pupil.agreement),
        ("odd planes predicted from even", pupil.held_out),
    )
    for label, score in scores:
        if score is not None:
            numbers = f"NCC {score.ncc:.4f} (mean of planes {score.plane_ncc:.4f}), NRMSE {score.nrmse:.4f}"
            lines.append(f"  {label}: {numbers}")
    lines += [
        f"  {name} = {value:.4g} +- {sigma:.2g}"
        for name, value, sigma in zip(
            pupil.names[:12], pupil.value, pupil.sigma, strict=False
        )
    ]
    return "\n".join(lines + ["  note: " + words for words in pupil.cautions])
