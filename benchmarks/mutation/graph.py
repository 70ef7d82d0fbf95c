"""Which test files reach which module, through the imports of the project and the
tables of its faces.
"""

import ast
import functools
import re
from collections import deque
from pathlib import Path

PACKAGES = ("metalens", "layout", "characterize", "codesign", "benchmarks")
_TRUTHS = re.compile(
    r"_(numbers|parts|truths)$"
)  # test files of closed forms and sums: quick, and they see most


class Graph:
    """Imports of the project under ``root``: modules, tests in a folder, and how far
    each is from each.
    """

    def __init__(self, root: Path, tests: str = "tests") -> None:
        self.root = root
        self.modules = {
            path.relative_to(root)
            .with_suffix("")
            .as_posix()
            .replace("/", ".")
            .removesuffix(".__init__"): path
            for package in PACKAGES
            for path in (root / package).rglob("*.py")
        }
        self.tests = sorted((root / tests).rglob("test_*.py"))
        self._reach = {test: self._distances(test) for test in self.tests}

    @functools.cached_property
    def compiled(self) -> set[str]:
        """Modules with compiled loops, and those that they import: their caches do not
        see a change of the latter.
        """
        words = re.compile(r"njit|^@compiled\b", re.M)
        own = {
            name
            for name, path in self.modules.items()
            if words.search(path.read_text(encoding="utf-8"))
        }
        return own | {home for name in own for home in self._uses(self.modules[name])}

    def related(
        self, module: str, seconds: dict[str, float], budget_s: float
    ) -> list[str]:
        """Test files that reach ``module``, within a budget: of its name (``_TRUTHS``
        first), of its folder with
        answers of their own; importing it and speaking of it most often (its folder
        counts for three times), nearest,
        quickest (shortest)."""
        folder = self.modules[module].relative_to(self.root).parent
        stem = self.modules[module].stem

        def order(test: Path) -> tuple[int, int, int, float, int]:
            own = self.root / "tests" / folder == test.parent
            named = re.search(rf"(^|_){stem}(_|$)", test.stem) is not None
            near = self._reach[test][module]
            spoken = (
                len(re.findall(rf"(?:\b|_){stem}\b", test.read_text(encoding="utf-8")))
                if near == 1
                else 0
            )
            spent = seconds.get(self._name(test), 1.0)
            truths = _TRUTHS.search(test.stem) is not None
            kind = (0 if truths else 1) if named else 2 if truths and near == 1 else 3
            return (
                kind if own else 3,
                -(spoken + 3 * own),
                near,
                spent,
                test.stat().st_size,
            )

        chosen, spent = [], 0.0
        for test in sorted(
            (t for t in self.tests if module in self._reach[t]), key=order
        ):
            cost = seconds.get(self._name(test), 10.0)
            if spent + cost <= budget_s or not chosen:
                chosen.append(self._name(test))
                spent += cost
        return chosen

    def _name(self, test: Path) -> str:
        return test.relative_to(self.root).as_posix()

    def _distances(self, test: Path) -> dict[str, int]:
        found: dict[str, int] = {}
        queue = deque((name, 1) for name in self._uses(test))
        while queue:
            name, distance = queue.popleft()
            if name not in found:
                found[name] = distance
                queue.extend(
                    (further, distance + 1)
                    for further in self._uses(self.modules[name])
                )
        return found

    @functools.cache  # noqa: B019 - one graph lives as long as the run
    def _uses(self, path: Path) -> list[str]:
        tree, found = ast.parse(path.read_text(encoding="utf-8")), []
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                found += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                found += [self._home(node.module, alias.name) for alias in node.names]
        found += self._helpers(path, tree)
        return [name for name in dict.fromkeys(found) if name in self.modules]

    def _home(self, module: str, name: str) -> str:
        if f"{module}.{name}" in self.modules:
            return f"{module}.{name}"
        return self._face(module).get(name, module)

    @functools.cache  # noqa: B019
    def _face(self, package: str) -> dict[str, str]:
        table: dict[str, str] = {}
        if package not in self.modules:
            return table
        for node in ast.walk(
            ast.parse(self.modules[package].read_text(encoding="utf-8"))
        ):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "attach":
                for key, value in ast.literal_eval(node.args[1]).items():
                    home = value.partition(":")[0]
                    table[key] = (
                        home if "." in home else f"{package}.{home}".rstrip(".")
                    )
        return table

    def _helpers(self, path: Path, tree: ast.AST) -> list[str]:
        """What the helper modules beside the tests import: ``bench_lens``,
        ``made_lens``.
        """
        if "tests" not in path.parts:
            return []
        names = {
            a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names
        }
        helpers = [
            p
            for p in (self.root / "tests").rglob("*.py")
            if p.stem in names and not p.stem.startswith("test_")
        ]
        return [
            name for helper in helpers if helper != path for name in self._uses(helper)
        ]
