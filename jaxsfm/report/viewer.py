"""A model in the browser, served by viser. It shows models that are too large for the page."""

import socket
import time
from typing import TYPE_CHECKING

import cv2
import numpy as np

from jaxsfm.errors import UserError
from jaxsfm.io import interrupt
from jaxsfm.io.extras import extra
from jaxsfm.io.images import shown_name, working_size
from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.report.scene import ShownCamera, shown_scene

if TYPE_CHECKING:
    import viser

THUMBNAIL = 240
"""The longer side of the photos in the frusta, pixels."""
MAX_THUMBNAILS = 500
"""The most cameras that show their photo: to read a thousand photos takes minutes."""
BLUE, ORANGE = (59, 130, 196), (224, 123, 57)


def _thumbnail(run: FinishedRun, name: str) -> np.ndarray | None:
    image = run.photos.read(name)
    if image is None:
        return None
    size = working_size((image.rgb.shape[1], image.rgb.shape[0]), THUMBNAIL)
    return cv2.resize(image.rgb, size, interpolation=cv2.INTER_AREA)


def fov_and_aspect(camera: ShownCamera) -> tuple[float, float]:
    """The vertical field of view in radians, and the width divided by the height."""
    x, y, _ = (camera.corners @ camera.pose.rotation.T).T
    return float(np.arctan(y.max()) - np.arctan(y.min())), float(np.ptp(x) / np.ptp(y))


class Viewer:
    """A scene on a server, and its controls."""

    def __init__(self, server: "viser.ViserServer", run: FinishedRun) -> None:
        self.server, self.run, self.scene = server, run, shown_scene(run)
        self._set_view()
        gui, size = server.gui, self.scene.frustum_depth / 20
        gui.set_panel_label("jaxsfm")
        gui.add_markdown(
            f"{len(self.scene.cameras)} cameras, {len(self.scene.points)} points. "
            "Click a camera to look through it."
        )
        self.through = gui.add_text("Through", "", disabled=True)
        points = server.scene.add_point_cloud(
            "/points",
            self.scene.points.astype(np.float32),
            self.scene.colours,
            point_size=size,
            precision="float32",
            point_shape="circle",
        )
        slider = gui.add_slider("Point size", min=0.1, max=5.0, step=0.1, initial_value=1.0)
        slider.on_update(lambda _: setattr(points, "point_size", size * slider.value))
        depth = self.scene.frustum_depth
        groups = [("cameras", self.scene.cameras, BLUE, depth)]
        if self.scene.reference:
            groups.append(("reference", self.scene.reference, ORANGE, 1.3 * depth))
        for name, cameras, colour, scale in groups:
            self._add_cameras(name, cameras, colour, scale)

    def _set_view(self) -> None:
        """Upright, from behind the cameras."""
        scene, start = self.scene, self.server.initial_camera
        self.server.scene.set_up_direction("+z")
        seen = np.concatenate([scene.points, [c.pose.centre for c in scene.cameras]])
        low, high = seen.min(0), seen.max(0)
        extent = float(np.linalg.norm(high - low)) or 1.0
        start.look_at = (low + high) / 2
        start.position = (low + high) / 2 + 0.8 * extent * scene.behind()
        start.near, start.far = 1e-4 * extent, 100 * extent

    def _add_cameras(
        self, group: str, cameras: list[ShownCamera], colour: tuple[int, int, int], scale: float
    ) -> None:
        """Frusta, a switch and a slider for them."""
        handles = []
        for k, camera in enumerate(cameras):
            shows = group == "cameras" and k < MAX_THUMBNAILS
            image = _thumbnail(self.run, camera.name) if shows else None
            handles.append(self._add_camera(f"/{group}/{k}", camera, colour, scale, image))
        gui = self.server.gui
        switch = gui.add_checkbox(f"Show {group}", initial_value=True)
        slider = gui.add_slider(f"Size of {group}", min=0.1, max=5.0, step=0.1, initial_value=1.0)

        def update(_: object) -> None:
            for handle in handles:
                handle.visible, handle.scale = switch.value, scale * slider.value

        switch.on_update(update)
        slider.on_update(update)

    def _add_camera(
        self,
        place: str,
        camera: ShownCamera,
        colour: tuple[int, int, int],
        scale: float,
        image: np.ndarray | None,
    ) -> "viser.CameraFrustumHandle":
        """Add a frustum. A click on it shows the view through the camera."""
        from viser.transforms import SO3

        fov, aspect = fov_and_aspect(camera)
        wxyz = SO3.from_matrix(camera.pose.rotation.T).wxyz
        handle = self.server.scene.add_camera_frustum(
            place,
            fov,
            aspect,
            scale=scale,
            color=colour,
            image=image,
            format="jpeg",  # not PNG, which Pillow must not encode beside pycolmap
            wxyz=wxyz,
            position=camera.pose.centre,
        )

        @handle.on_click
        def _(event: "viser.SceneNodePointerEvent") -> None:
            self.through.value = shown_name(camera.name)
            with event.client.atomic():
                event.client.camera.wxyz = wxyz
                event.client.camera.position = camera.pose.centre
                event.client.camera.fov = fov

        return handle


def _check_address(host: str) -> None:
    """Raises UserError for an address that viser could not listen on: it would wait for ever."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as trial:
            trial.bind(address)
    except OSError as error:
        raise UserError(f"--host {host}: cannot be listened on ({error.strerror})") from error


def serve(run: FinishedRun, *, host: str, port: int) -> None:
    """Show the model of a run until Ctrl-C.

    Raises:
      UserError: viser is not installed, the run has no model, or the address cannot be used.
    """
    with extra("view", "jaxsfm view needs"):
        import viser
    if run.model is None:
        raise UserError(f"{run.folder}: no model to show (sparse/0)")
    _check_address(host)
    server = viser.ViserServer(host=host, port=port, label="jaxsfm", verbose=False)
    try:
        Viewer(server, run)
        print(f"http://{host}:{server.get_port()} (Ctrl-C ends it)", flush=True)
        while True:
            interrupt.check()
            time.sleep(0.2)
    except KeyboardInterrupt:  # this is how a user ends it
        print()
    finally:
        server.stop()
