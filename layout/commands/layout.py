"""One lens to its mask, or an arrangement of lenses and cells to that of a die or
wafer.
"""

from pathlib import Path

from layout.commands import make
from layout.commands.job import LayoutJob, Options

ARRANGEMENT = ".toml"  # the ending of a file that arranges lenses


def run(options: Options) -> int:
    """Make the mask; exit 1 where a rule is broken or a file does not read back as
    planned.

    Args:
        options: of the command.
    """
    if options.lens.suffix.lower() == ARRANGEMENT:
        from layout.commands import arrangement

        return arrangement.make_floorplan(options)
    with options.claim_folder(options.output) as draft, options.shared():
        job = make.make_mask(make.draw_lens(options), draft.path)
    return options.console.judged(
        make.values_of(job), _text(job, options.output), job.failures
    )


def _text(job: LayoutJob, target: Path) -> str:
    """Summary for a person: verdict, files, differences and first violations."""
    lines = [*([job.verdict] if job.ok else []), job.drc.summary]
    for name, size in job.written.items():
        outcome = job.compared.get(name)
        verdict = ""
        if outcome is not None:
            as_planned = ", reads back as planned"
            verdict = as_planned if outcome.ok else ", DIFFERS FROM THE PLAN"
        lines.append(f"  {target / name}: {size / 1e6:.3g} MB{verdict}")
        if outcome is not None:
            lines += [f"    {difference}" for difference in outcome.differences[:10]]
    lines += [
        f"  {violation.rule} at ({violation.centre[0]:.0f}, "
        f"{violation.centre[1]:.0f}) nm: {violation.summary}"
        for violation in job.drc.violations[:10]
    ]
    lines.append(f"  {target / 'report.html'}")
    return "\n".join(lines)
