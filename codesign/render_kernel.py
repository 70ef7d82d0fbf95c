"""The scene model compiled: float32 scalars for frames, dual numbers of two tangents for exact derivatives.

The source of :mod:`codesign.render_model` is rewritten, operators into calls, and compiled twice by numba with two
sets of those calls. Nothing else knows the scene.
"""

import ast
import inspect
import math
import zlib
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from codesign import render_model as model

Array = np.ndarray[Any, np.dtype[Any]]
_OPERATORS = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul", ast.Div: "div"}
_SETTINGS: dict[str, Any] = {"fastmath": True, "error_model": "numpy"}
f32 = np.float32
_jit = numba.njit(**_SETTINGS)


class _Calls(ast.NodeTransformer):
    """Operators, numbers and parameters become calls: add, sub, mul, div, neg, number, load, fixed."""

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        call = _call(_OPERATORS[type(node.op)], self.visit(node.left), self.visit(node.right))
        return ast.copy_location(call, node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        return ast.copy_location(_call("neg", self.visit(node.operand)), node)

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        return ast.copy_location(_call("number", node), node)

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        names = {part.id for part in ast.walk(node.slice) if isinstance(part, ast.Name)}
        return ast.copy_location(_call("load" if names & model.MOVING else "fixed", node.value, node.slice), node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        docstring = isinstance(node.body[0], ast.Expr)
        node.body = [self.visit(line) for line in node.body[docstring:]]
        node.returns, node.args = None, _bare(node.args)
        return node


def _call(name: str, *arguments: Any) -> ast.Call:
    return ast.Call(func=ast.Name(id=name, ctx=ast.Load()), args=list(arguments), keywords=[])


def _bare(arguments: ast.arguments) -> ast.arguments:
    for argument in arguments.args:
        argument.annotation = None
    return arguments


def _compiled(operations: dict[str, Any]) -> dict[str, Any]:
    """The functions of the model, compiled on these operations."""
    tree = ast.parse(inspect.getsource(model))
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    module = ast.Module([_Calls().visit(node) for node in functions], [])
    space = {name: value for name, value in vars(model).items() if isinstance(value, int)} | operations
    exec(compile(ast.fix_missing_locations(module), inspect.getsourcefile(model) or "", "exec"), space)
    for node in functions:
        space[node.name] = _jit(space[node.name])
    return space


def _scalar_operations() -> dict[str, Any]:
    def step(x: Any) -> Any:
        t = min(max(f32(0.5) + f32(0.5) * x, f32(0)), f32(1))
        return t * t * (f32(3) - f32(2) * t)

    def tex(bank: Any, index: Any, u: Any, v: Any) -> Any:
        value, _, _ = _sample(bank, index, u, v)
        return value

    plain: dict[str, Callable[..., Any]] = {
        "add": lambda a, b: a + b,
        "sub": lambda a, b: a - b,
        "mul": lambda a, b: a * b,
        "div": lambda a, b: a / b,
        "neg": lambda a: -a,
        "number": lambda value: f32(value),
        "load": lambda p, i: p[i],
        "fixed": lambda p, i: p[i],
        "sqrt": lambda x: math.sqrt(x),
        "unit": lambda x: min(max(x, f32(0)), f32(1)),
        "above": lambda x, least: max(x, f32(least)),
        "step": step,
        "tex": tex,
    }
    return {name: _jit(function) for name, function in plain.items()}


def _dual_operations() -> dict[str, Any]:
    """Numbers (value, tangent, tangent)."""

    def div(a: Any, b: Any) -> Any:
        k = f32(1) / b[0]
        v = a[0] * k
        return (v, (a[1] - v * b[1]) * k, (a[2] - v * b[2]) * k)

    def sqrt(x: Any) -> Any:
        v = math.sqrt(x[0])
        k = f32(0.5) / v
        return (v, k * x[1], k * x[2])

    def unit(x: Any) -> Any:
        k = f32(1) if f32(0) < x[0] < f32(1) else f32(0)
        return (min(max(x[0], f32(0)), f32(1)), k * x[1], k * x[2])

    def above(x: Any, least: Any) -> Any:
        k = f32(1) if x[0] > least[0] else f32(0)
        return (max(x[0], least[0]), k * x[1], k * x[2])

    def step(x: Any) -> Any:
        t = min(max(f32(0.5) + f32(0.5) * x[0], f32(0)), f32(1))
        k = f32(3) * t * (f32(1) - t)
        return (t * t * (f32(3) - f32(2) * t), k * x[1], k * x[2])

    def tex(bank: Any, index: Any, u: Any, v: Any) -> Any:
        value, du, dv = _sample(bank, index[0], u[0], v[0])
        return (value, du * u[1] + dv * v[1], du * u[2] + dv * v[2])

    dual: dict[str, Callable[..., Any]] = {
        "add": lambda a, b: (a[0] + b[0], a[1] + b[1], a[2] + b[2]),
        "sub": lambda a, b: (a[0] - b[0], a[1] - b[1], a[2] - b[2]),
        "mul": lambda a, b: (a[0] * b[0], a[0] * b[1] + a[1] * b[0], a[0] * b[2] + a[2] * b[0]),
        "div": div,
        "neg": lambda a: (-a[0], -a[1], -a[2]),
        "number": lambda value: (f32(value), f32(0), f32(0)),
        "load": lambda p, i: (p[0, i], p[1, i], p[2, i]),
        "fixed": lambda p, i: (p[0, i], f32(0), f32(0)),
        "sqrt": sqrt,
        "unit": unit,
        "above": above,
        "step": step,
        "tex": tex,
    }
    return {name: _jit(function) for name, function in dual.items()}


@_jit  # type: ignore[untyped-decorator]
def _sample(bank: Any, index: Any, u: Any, v: Any) -> Any:
    """Smooth periodic sample and its slopes; the size of the pictures is a power of two."""
    size = bank.shape[1]
    fu, fv = np.floor(u), np.floor(v)
    i, j, k = np.int32(fu) & (size - 1), np.int32(fv) & (size - 1), np.int32(index)
    right, down = (i + 1) & (size - 1), (j + 1) & (size - 1)
    s, t = f32(u - fu), f32(v - fv)
    ds, dt = f32(6) * s * (f32(1) - s), f32(6) * t * (f32(1) - t)
    s, t = s * s * (f32(3) - f32(2) * s), t * t * (f32(3) - f32(2) * t)
    a, b, c, d = bank[k, j, i], bank[k, j, right], bank[k, down, i], bank[k, down, right]
    top, bottom = a + (b - a) * s, c + (d - c) * s
    return top + (bottom - top) * t, ds * ((b - a) + ((d - c) - (b - a)) * t), dt * (bottom - top)


_s = _compiled(_scalar_operations())
_s_ray, _s_lids, _s_skin = _s["ray"], _s["lids"], _s["skin"]
_d = _compiled(_dual_operations())
_d_ray, _d_lids, _d_skin = _d["ray"], _d["lids"], _d["skin"]
_d_add, _d_mul, _d_sub = _d["add"], _d["mul"], _d["sub"]
_s_globe, _s_cornea, _s_iris, _s_sclera, _s_shade = (_s[k] for k in ("globe", "cornea", "iris", "sclera", "shade"))
_d_globe, _d_cornea, _d_iris, _d_sclera, _d_shade = (_d[k] for k in ("globe", "cornea", "iris", "sclera", "shade"))


@_jit  # type: ignore[untyped-decorator]
def _s_eye(p: Any, t: Any, gx: Any, gy: Any, upper: Any, lower: Any, dx: Any, dy: Any, dz: Any) -> Any:
    """The model's ``eye``, without the iris where no cornea is met, and without the sclera where the iris hides it."""
    ts, mx, my, mz = _s_globe(p, dx, dy, dz)
    tc, cx, cy, cz, inside = _s_cornea(p, dx, dy, dz)
    disc = pupil = brown = virtual = white = r = f32(0)
    if inside > f32(0):
        disc, pupil, r, brown, virtual = _s_iris(p, t, tc, cx, cy, cz, inside, dx, dy, dz)
    if disc < f32(1):
        white = _s_sclera(p, t, gx, gy, lower, mx, my, mz, r, inside)
    light = _s_shade(p, white, brown, disc, pupil, inside, upper, lower, ts, mx, my, mz, tc, cx, cy, cz, dx, dy, dz)
    return light, ts + disc * (tc + virtual - ts), pupil


@_jit  # type: ignore[untyped-decorator]
def _d_eye(p: Any, t: Any, gx: Any, gy: Any, upper: Any, lower: Any, dx: Any, dy: Any, dz: Any) -> Any:
    """As :func:`_s_eye`, for dual numbers: shares of exactly 0 or 1 have no slope."""
    zero = (f32(0), f32(0), f32(0))
    ts, mx, my, mz = _d_globe(p, dx, dy, dz)
    tc, cx, cy, cz, inside = _d_cornea(p, dx, dy, dz)
    disc, pupil, brown, virtual, white, r = zero, zero, zero, zero, zero, zero
    if inside[0] > f32(0):
        disc, pupil, r, brown, virtual = _d_iris(p, t, tc, cx, cy, cz, inside, dx, dy, dz)
    if disc[0] < f32(1):
        white = _d_sclera(p, t, gx, gy, lower, mx, my, mz, r, inside)
    light = _d_shade(p, white, brown, disc, pupil, inside, upper, lower, ts, mx, my, mz, tc, cx, cy, cz, dx, dy, dz)
    behind = _d_mul(disc, _d_sub(_d_add(tc, virtual), ts))
    return light, _d_add(ts, behind), pupil


def _kernels(stamp: int) -> tuple[Any, Any]:
    """The two loops over pixels; ``stamp`` of the model's source enters the key of numba's cache on disk."""

    @numba.njit(parallel=True, cache=True, **_SETTINGS)  # type: ignore[untyped-decorator]
    def frames(
        parameters: Array, bank: Array, u: Array, w: Array, light: Array, cover: Array, depth: Array, pupil: Array
    ) -> None:
        """Render frames: parameters (n, COUNT), tangents u (x,), w (y,); fills light, cover, depth (n, 2, y, x), pupil.

        Sheet 0 is skin, sheet 1 the eye; light is multiplied by the coverage. What is hidden is not shaded.
        """
        if stamp == 0:
            return
        for job in numba.prange(parameters.shape[0] * len(w)):
            n, row = job // len(w), job % len(w)
            p = parameters[n]
            for column in range(len(u)):
                dx, dy, dz = _s_ray(u[column], w[row])
                s, seen, gx, gy, upper, lower, nx, ny, nz = _s_lids(p, dx, dy, dz)
                near = far = z = hole = f32(0)
                if seen < f32(1):
                    near = _s_skin(p, bank, s, gx, gy, upper, lower, dx, dy, dz, nx, ny, nz) * (f32(1) - seen)
                if seen > f32(0):
                    far, z, hole = _s_eye(p, bank, gx, gy, upper, lower, dx, dy, dz)
                light[n, 0, row, column], light[n, 1, row, column] = near, far * seen
                cover[n, 0, row, column], cover[n, 1, row, column] = f32(1) - seen, seen
                depth[n, 0, row, column], depth[n, 1, row, column] = s * dz, z * dz
                pupil[n, row, column] = hole * seen

    @numba.njit(parallel=True, cache=True, **_SETTINGS)  # type: ignore[untyped-decorator]
    def tangents(parameters: Array, bank: Array, u: Array, w: Array, out: Array) -> None:
        """Frames and two directional derivatives: parameters (n, 3, COUNT) hold values and two tangents.

        Fills out (n, 3, 5, y, x): light of skin and eye, coverage of the eye, depth of skin and eye.
        """
        if stamp == 0:
            return
        zero, one = (f32(0), f32(0), f32(0)), (f32(1), f32(0), f32(0))
        for job in numba.prange(parameters.shape[0] * len(w)):
            n, row = job // len(w), job % len(w)
            p = parameters[n]
            for column in range(len(u)):
                dx, dy, dz = _d_ray((u[column], f32(0), f32(0)), (w[row], f32(0), f32(0)))
                s, seen, gx, gy, upper, lower, nx, ny, nz = _d_lids(p, dx, dy, dz)
                near, far, z = zero, zero, zero
                if seen[0] < f32(1):
                    near = _d_skin(p, bank, s, gx, gy, upper, lower, dx, dy, dz, nx, ny, nz)
                    near = _d_mul(near, _d_sub(one, seen))
                if seen[0] > f32(0):
                    far, z, _ = _d_eye(p, bank, gx, gy, upper, lower, dx, dy, dz)
                    far = _d_mul(far, seen)
                d0, d1 = _d_mul(s, dz), _d_mul(z, dz)
                for k in range(3):
                    out[n, k, 0, row, column], out[n, k, 1, row, column] = near[k], far[k]
                    out[n, k, 2, row, column] = seen[k]
                    out[n, k, 3, row, column], out[n, k, 4, row, column] = d0[k], d1[k]

    return frames, tangents


frames, tangents = _kernels(1 + zlib.crc32(inspect.getsource(model).encode()))
