"""Where points of the eye and face land in the image: canthi, lid margins, limbus, and
the pupil through the cornea.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

NAMES = (
    "medial canthus", "lateral canthus", "upper margin", "lower margin",
    "limbus temporal", "limbus down", "limbus nasal", "limbus up", "corneal apex",
)  # fmt: skip


def project_points(points_um: Tensor) -> Tensor:
    """(..., 2) tangents x / z, y / z of points (..., 3), z of 500 um at least.

    Args:
        points_um: (..., 3) points before the camera.
    """
    return points_um[..., :2] / points_um[..., 2:].clamp_min(500.0)


def landmark_points(p: Mapping[str, Tensor]) -> Tensor:
    """(n, len(NAMES), 2) tangents x / z, y / z of the landmarks, without refraction.

    Canthi and lid margins on the lid sphere, four points of the limbus, corneal apex.

    Args:
        p: of :func:`codesign.eye.model_parameters`.
    """
    centre, axis, across, below = (
        p[name] for name in ("centre", "axis", "iris_x", "iris_y")
    )
    middle, half, upper, lower, lid, ring, radius, ball, cornea = (
        p[name][:, None]
        for name in (
            "middle", "half", "upper", "lower", "lid_r", "limbus_d", "limbus_r",
            "cornea_d", "cornea_r",
        )
    )  # fmt: skip

    def on_lid(x: Tensor, y: Tensor) -> Tensor:
        z = torch.sqrt((lid**2 - x**2 - y**2).clamp_min(1e4))
        return centre + x * p["face_x"] + y * p["face_y"] + z * p["face_z"]

    zero = torch.zeros_like(middle)
    points = [on_lid(middle - 0.98 * half, zero), on_lid(middle + 0.98 * half, zero)]
    points += [on_lid(middle, -upper), on_lid(middle, lower)]
    points += [
        centre + ring * axis + radius * side
        for side in (across, below, -across, -below)
    ]
    points.append(centre + (ball + cornea) * axis)
    return project_points(torch.stack(points, 1))


def trace_to_iris(p: Mapping[str, Tensor], tangents: Tensor) -> Tensor:
    """(k, n, m, 2) points, um, where rays meet the iris plane behind the cornea.

    Snell's law at the corneal sphere, as in :mod:`codesign.eye.kernel`.

    Args:
        p: of :func:`codesign.eye.model_parameters`.
        tangents: (k, n, m, 2) of the rays.
    """
    # vectors along the first axis: sums over it are quick
    centre, axis, across, below = (
        p[name].mT[:, None, :, None] for name in ("centre", "axis", "iris_x", "iris_y")
    )
    ball, radius, index, plane = (
        p[name][:, None] for name in ("cornea_d", "cornea_r", "index", "pupil_d")
    )
    ray = torch.stack([*tangents.unbind(-1), torch.ones_like(tangents[..., 0])])
    ray = ray / (ray * ray).sum(0).sqrt()
    cornea = centre + ball * axis
    along = (cornea * ray).sum(0)
    closest = cornea - along * ray
    discriminant = radius**2 - (closest * closest).sum(0)
    hit = (along - discriminant.clamp_min(1e4).sqrt()) * ray
    normal = (hit - cornea) / radius
    eta, cosine = 1 / index, -(normal * ray).sum(0)
    bend = eta * cosine - (1 - eta**2 * (1 - cosine**2)).clamp_min(1e-4).sqrt()
    refracted = eta * ray + bend * normal
    point = hit - centre - plane * axis
    slope = -(refracted * axis).sum(0)
    path = ((point * axis).sum(0) / slope.clamp_min(0.05)).clamp_min(0)
    point = point + path * refracted
    return torch.stack([(point * across).sum(0), (point * below).sum(0)], -1)


def iris_to_camera(
    p: Mapping[str, Tensor], iris_um: Tensor, *, steps: int = 12
) -> Tensor:
    """(n, m, 2) tangents of the rays that reach points of the iris plane after
    refraction.

    Damped Newton iteration on :func:`trace_to_iris` with forward differences, from the
    straight projection of the entrance pupil.

    Args:
        p: of :func:`codesign.eye.model_parameters`.
        iris_um: (n, m, 2) points in the plane of the iris.
        steps: Newton steps at most.

    Returns:
        tangents; 1e-9 accurate where the cornea shows the point. Where the iteration
        does not converge, for an eye turned away from the camera, the straight
        projection: always finite.
    """
    centre, axis, across, below = (
        p[name][:, None] for name in ("centre", "axis", "iris_x", "iris_y")
    )
    # entrance pupil: apparent position 0.55 mm nearer, 13 % larger
    lift = p["pupil_d"][:, None, None] + 550.0
    straight = project_points(
        centre
        + lift * axis
        + 1.13 * (iris_um[..., :1] * across + iris_um[..., 1:] * below)
    )
    tangents = straight
    offsets = 1e-6 * torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]).to(tangents)
    for _ in range(steps):
        here, right, down = trace_to_iris(p, tangents + offsets[:, None, None])
        error = here - iris_um
        # 1e-6 um on the iris are 1e-9 of a tangent
        if not tangents.requires_grad and float(error.abs().max()) < 1e-6:
            break
        slope = torch.stack([right - here, down - here], -1) / 1e-6
        step = torch.linalg.solve_ex(slope, error[..., None])[0][..., 0]
        tangents = tangents - step.nan_to_num().clamp(-0.05, 0.05)
    converged = (
        (trace_to_iris(p, tangents[None])[0] - iris_um).norm(dim=-1, keepdim=True) < 1.0
    ) & ((tangents - straight).norm(dim=-1, keepdim=True) < 0.3)
    return torch.where(converged, tangents, straight)
