"""The mutants of a run as a table: killed and left, by folder and by rule, then every
survivor.
"""

from collections import defaultdict

Row = dict[str, object]
FARTHER = "killed farther off"  # by test files beyond the nearest
LEFT = ("survived", "no test")


def markdown(rows: list[Row], command: str, drawn: str = "", commit: str = "") -> str:
    """A page for readers of the repository. drawn: the summary before the survivors
    were judged once more; commit: of
    the source that the mutants were drawn from."""
    of = f" on {commit}" if commit else ""
    out = [
        "# One-line mutants of the numeric code",
        "",
        f"Made by `{command}`{of}.",
        "",
    ]
    if drawn:
        out += [
            f"As drawn: {drawn}",
            "",
            "Survivors have tests since, were found to be equivalent, or went with their source; judged once more:",
            "",
        ]
    out += [summary(rows), ""]
    for head, key in (
        ("folder", lambda r: "/".join(str(r["path"]).split("/")[:2])),
        ("rule", lambda r: str(r["rule"])),
    ):
        groups = defaultdict(list)
        for row in rows:
            groups[key(row)].append(row)
        out += [
            f"| {head} | mutants | killed | left | of them equivalent |",
            "|---|---|---|---|---|",
        ]
        for name in sorted(groups):
            left = [r for r in groups[name] if r["outcome"] in LEFT]
            equal = sum("reason" in r for r in left)
            out.append(
                f"| {name} | {len(groups[name])} | {len(groups[name]) - len(left)} | {len(left)} | {equal} |"
            )
        out.append("")
    left = [r for r in rows if r["outcome"] in LEFT]
    if left:
        out += ["| left | was | became | why no test can tell |", "|---|---|---|---|"]
        out += [
            f"| {r['path']} | `{r['was']}` | `{r['became']}` | {r.get('reason', 'open')} |"
            for r in left
        ]
    return "\n".join(out).rstrip() + "\n"


def summary(rows: list[Row]) -> str:
    """One line: how many were killed, over all and on lines that make an error bar."""
    parts = []
    for name, part in (
        ("all", rows),
        (
            "on lines that make an error, a sigma, a variance or a weight",
            [r for r in rows if r["bar"]],
        ),
    ):
        equal = [r for r in part if r["outcome"] in LEFT and "reason" in r]
        killed = [r for r in part if r["outcome"] not in LEFT]
        if part:
            counted = len(part) - len(equal)
            share = len(killed) / max(counted, 1)
            far = sum(r["outcome"] == FARTHER for r in killed)
            beyond = (
                f" (of them {far} by test files farther off than the nearest)"
                if far
                else ""
            )
            parts.append(
                f"{name}: {len(killed)} of {counted} killed ({share:.1%}){beyond}, {len(equal)} more are equivalent"
            )
    return "; ".join(parts) + "."
