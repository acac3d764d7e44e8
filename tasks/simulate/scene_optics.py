"""The optics of a scene's sensors: those that the log reports, and the true ones."""

import math

from epipole.schemas.simulation.scene import SceneCamera
from epipole.tasks.algorithms.simulation.optics import TrueOptics


def sent_optics(camera: SceneCamera) -> TrueOptics:
    """Return the optics that the log reports."""
    if camera.focal_px is not None:
        focal = camera.focal_px
    else:
        focal = camera.width / 2 / math.tan(math.radians(camera.fov_deg or 0.0) / 2)
    cx = (camera.width - 1) / 2 if camera.cx_px is None else camera.cx_px
    cy = (camera.height - 1) / 2 if camera.cy_px is None else camera.cy_px
    lens = camera.k1, camera.k2, camera.p1, camera.p2, camera.k3
    return TrueOptics(camera.width, camera.height, focal, focal, cx, cy, *lens)


def true_optics(camera: SceneCamera) -> TrueOptics:
    """Return the true optics, which make the image."""
    sent, off = sent_optics(camera), camera.departure
    return sent._replace(
        fx_px=sent.fx_px * (1 + off.focal),
        fy_px=sent.fy_px * (1 + off.focal),
        **{
            name: getattr(sent, name) + getattr(off, name)
            for name in ("cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
        },
    )
