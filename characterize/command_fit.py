"""Bench captures -> the lens (or the pupil) that made them, with intervals, degeneracies and a report."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import tyro

from characterize import capture as captures
from characterize.pupil import PupilSpec
from characterize.pupilfit import PupilFit, fit_pupil, save
from metalens import config, store
from metalens.commands import Common, Output
from metalens.errors import ConfigError


@dataclass(frozen=True)
class Options(Common):
    """Options of ``metalens fit``.

    Attributes:
        capture: folder, or TIFF, PNG or HDF5 stack.
        pupil: TOML of what is known of a generic lens (numerical_aperture, wavelength_um, pixel_um, step_um ...).
        output: file to write; a report lies beside it as .html.
    """

    capture: tyro.conf.Positional[Path]
    pupil: Path
    output: Output


def run(options: Options) -> int:
    """Fit; exit 0 when the fit converged, 1 when it is refused by its own checks."""
    target = options.claim(options.output)
    if target.suffix != ".h5":
        raise ConfigError(f"{target}: need a name that ends in .h5")
    spec = config.load(options.pupil, PupilSpec)
    fit = fit_pupil(captures.load(options.capture), spec)
    inputs = {p.name: store.sha256(p) for p in _files(options.capture)} | {
        options.pupil.name: store.sha256(options.pupil)
    }
    save(target, fit, store.Provenance(config=options.pupil.read_text(encoding="utf-8"), inputs=inputs))
    from characterize.report import pupil_report

    page = target.with_suffix(".html")
    pupil_report(page, fit)
    options.console.result(_values(fit), _text(fit, target))
    return 0 if fit.converged else 1


def _files(path: Path) -> list[Path]:
    return sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]


def _values(fit: PupilFit) -> dict[str, object]:
    scores = {"agreement": fit.agreement, "held_out": fit.held_out}
    return {
        **{key: dataclasses.asdict(score) for key, score in scores.items() if score is not None},
        "chi2_per_dof": fit.chi2_per_dof,
        "converged": fit.converged,
        "reason": fit.reason,
        "parameters": {n: [float(v), float(s)] for n, v, s in zip(fit.names, fit.value, fit.sigma, strict=True)},
        "cautions": list(fit.cautions),
    }


def _text(fit: PupilFit, target: Path) -> str:
    lines = [f"{target}: pupil fitted to {len(fit.measured)} planes; {fit.reason}"]
    for label, score in (("all planes fitted", fit.agreement), ("odd planes predicted from even", fit.held_out)):
        if score is not None:
            lines.append(
                f"  {label}: NCC {score.ncc:.4f} (mean of planes {score.plane_ncc:.4f}), NRMSE {score.nrmse:.4f}"
            )
    lines += [f"  {n} = {v:.4g} +- {s:.2g}" for n, v, s in zip(fit.names[:12], fit.value, fit.sigma, strict=False)]
    return "\n".join(lines + ["  note: " + words for words in fit.cautions])
