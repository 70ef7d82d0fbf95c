"""Where points of the eye and face land in the image: canthi, lid margins, limbus, and
the pupil through the cornea.
"""

import torch
from torch import Tensor

from codesign.eye import model

NAMES = (
    "medial canthus", "lateral canthus", "upper margin", "lower margin",
    "limbus right", "limbus down", "limbus left", "limbus up", "corneal apex",
)  # fmt: skip
SETTLED_UM = 1e-6  # from the wanted point on the iris: 1e-9 of a tangent
# points closer than this, or behind the camera, are projected as if they were this far
NEAREST_UM = 500.0


def project_points(points_um: Tensor) -> Tensor:
    """(..., 2) tangents x / z, y / z of points (..., 3).

    Args:
        points_um: (..., 3) points before the camera.
    """
    return points_um[..., :2] / points_um[..., 2:].clamp_min(NEAREST_UM)


def landmark_points(p: Tensor) -> Tensor:
    """(n, len(NAMES), 2) tangents of the landmarks of frames with parameters ``p`` (n,
    COUNT).
    """
    centre, axis, across, below, right, down, out = (
        p[:, k : k + 3]
        for k in (
            model.CENTRE,
            model.AXIS,
            model.IRIS_X,
            model.IRIS_Y,
            model.FACE_X,
            model.FACE_Y,
            model.FACE_Z,
        )
    )
    v = p[:, :, None]
    middle, half = v[:, model.MIDDLE], 0.98 * v[:, model.HALF]

    def on_lid(x: Tensor, y: Tensor) -> Tensor:
        z = torch.sqrt((v[:, model.LID_R] ** 2 - x**2 - y**2).clamp_min(1e4))
        return centre + x * right + y * down + z * out

    zero = torch.zeros_like(middle)
    ring, radius = v[:, model.LIMBUS_D], v[:, model.LIMBUS_R]
    points = [on_lid(middle - half, zero), on_lid(middle + half, zero)]
    points += [on_lid(middle, -v[:, model.UPPER]), on_lid(middle, v[:, model.LOWER])]
    points += [
        centre + ring * axis + radius * way for way in (across, below, -across, -below)
    ]
    points.append(centre + (v[:, model.CORNEA_D] + v[:, model.CORNEA_R]) * axis)
    return project_points(torch.stack(points, 1))


def trace_to_iris(p: Tensor, tangents: Tensor) -> Tensor:
    """(k, n, m, 2) points of the iris plane, um, that rays meet behind the cornea: Snell's
    law at its sphere, as in :mod:`codesign.eye.kernel`.

    Args:
        p: (n, COUNT) parameters. tangents: (k, n, m, 2) of the rays.
    """
    q = p.mT[:, None, :, None]  # vectors along the first axis: sums over it are quick
    centre, axis, across, below = (
        q[k : k + 3] for k in (model.CENTRE, model.AXIS, model.IRIS_X, model.IRIS_Y)
    )
    ray = torch.stack([*tangents.unbind(-1), torch.ones_like(tangents[..., 0])])
    ray = ray / (ray * ray).sum(0).sqrt()
    ball = centre + q[model.CORNEA_D] * axis
    along = (ball * ray).sum(0)
    off = ball - along * ray
    free = q[model.CORNEA_R] ** 2 - (off * off).sum(0)
    hit = (along - free.clamp_min(1e4).sqrt()) * ray
    normal = (hit - ball) / q[model.CORNEA_R]
    eta, cosine = 1 / q[model.INDEX], -(normal * ray).sum(0)
    bend = eta * cosine - (1 - eta**2 * (1 - cosine**2)).clamp_min(1e-4).sqrt()
    inward = eta * ray + bend * normal
    point = hit - centre - q[model.PUPIL_D] * axis
    slope = -(inward * axis).sum(0)
    path = ((point * axis).sum(0) / slope.clamp_min(0.05)).clamp_min(0)
    point = point + path * inward
    return torch.stack([(point * across).sum(0), (point * below).sum(0)], -1)


def iris_to_camera(p: Tensor, iris_um: Tensor, *, steps: int = 12) -> Tensor:
    """Tangents of the rays that reach points of the iris plane after refraction, by a
    damped Newton iteration.

    Args:
        p: (n, COUNT) parameters.
        iris_um: (n, m, 2) points in the plane of the iris.
        steps: Newton steps at most.

    Returns:
        (n, m, 2) tangents; 1e-9 accurate where the cornea shows the point. For an eye
        that is turned away from the
        camera, the straight projection where the iteration does not converge: always
        finite.
    """
    centre, axis, across, below = (
        p[:, None, k : k + 3]
        for k in (model.CENTRE, model.AXIS, model.IRIS_X, model.IRIS_Y)
    )
    lift = (
        p[:, None, model.PUPIL_D, None] + 550.0
    )  # entrance pupil: the pupil seems nearer by 0.55 mm, 13 % larger
    straight = project_points(
        centre
        + lift * axis
        + 1.13 * (iris_um[..., :1] * across + iris_um[..., 1:] * below)
    )
    t, h = straight, 1e-6
    around = h * torch.tensor(
        [[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=t.dtype
    )
    for _ in range(steps):
        here, right, left, down, up = trace_to_iris(p, t + around[:, None, None])
        miss = here - iris_um
        if not t.requires_grad and float(miss.abs().max()) < SETTLED_UM:
            break
        along_x = (right - left) / (2 * h)
        along_y = (down - up) / (2 * h)
        det = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]
        det = torch.where(det.abs() < 1e3, 1e3, det)
        dx = (along_y[..., 1] * miss[..., 0] - along_y[..., 0] * miss[..., 1]) / det
        dy = (along_x[..., 0] * miss[..., 1] - along_x[..., 1] * miss[..., 0]) / det
        t = t - torch.stack([dx, dy], -1).clamp(-0.05, 0.05)
    good = (
        (trace_to_iris(p, t[None])[0] - iris_um).norm(dim=-1, keepdim=True) < 1.0
    ) & ((t - straight).norm(dim=-1, keepdim=True) < 0.3)
    return torch.where(good, t, straight)
