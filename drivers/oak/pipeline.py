"""The depthai graph: what the device computes, and one group of frames per exposure."""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from datetime import timedelta

import depthai as dai

from drivers.oak.frames import Exposure
from drivers.oak.messages import OakConfig

_COLOR, _LEFT, _RIGHT = (
    dai.CameraBoardSocket.CAM_A,
    dai.CameraBoardSocket.CAM_B,
    dai.CameraBoardSocket.CAM_C,
)
_CM = 0.01


@contextmanager
def running(config: OakConfig, info: dai.DeviceInfo) -> Iterator[Callable[[], Exposure | None]]:
    """Boot the device and run the graph; yields what returns the newest exposure, None if none.

    Raises:
        RuntimeError: the device cannot be opened, or (from what was yielded) is lost.
    """
    with closing(dai.Device(info)) as device, dai.Pipeline(device) as pipeline:
        baseline_m = _CM * device.readCalibration().getBaselineDistance(_RIGHT, _LEFT, False)
        sync = pipeline.create(dai.node.Sync)
        sync.setSyncThreshold(timedelta(seconds=0.5 / config.frames_per_s))
        for name, output in _outputs(pipeline, config).items():
            output.link(sync.inputs[name])
        queue = sync.out.createOutputQueue(maxSize=1, blocking=False)
        pipeline.start()

        def newest() -> Exposure | None:
            try:
                group = queue.tryGet()
            except dai.MessageQueue.QueueException as error:
                raise RuntimeError("the device was lost: check cable and power") from error
            if not isinstance(group, dai.MessageGroup):
                return None
            frames = {name: frame for name, frame in group if isinstance(frame, dai.ImgFrame)}
            return Exposure(frames=frames, baseline_m=baseline_m)

        yield newest


def _outputs(pipeline: dai.Pipeline, config: OakConfig) -> dict[str, dai.Node.Output]:
    stereo = _stereo(pipeline, config)
    if config.eye == "left":
        stereo.setDepthAlign(dai.StereoDepthConfig.AlgorithmControl.DepthAlign.RECTIFIED_LEFT)
        return {
            "left": stereo.rectifiedLeft,
            "right": stereo.rectifiedRight,
            "depth": stereo.depth,
        }
    camera = pipeline.create(dai.node.Camera).build(_COLOR)
    color = camera.requestOutput(
        (config.width_px, config.height_px),
        dai.ImgFrame.Type.RGB888i,
        dai.ImgResizeMode.CROP,
        config.frames_per_s,
        enableUndistortion=True,
    )
    return {"color": color, "depth": _aligned(pipeline, stereo, color)}


def _stereo(pipeline: dai.Pipeline, config: OakConfig) -> dai.node.StereoDepth:
    """Return the matcher: left-right check against false depth, subpixel for thin wood."""
    stereo = pipeline.create(dai.node.StereoDepth)
    stereo.setRectification(True)
    stereo.setLeftRightCheck(True)
    stereo.setSubpixel(True)
    for socket, side in ((_LEFT, stereo.left), (_RIGHT, stereo.right)):
        camera = pipeline.create(dai.node.Camera).build(socket)
        camera.requestOutput(config.stereo_size_px, fps=config.frames_per_s).link(side)
    return stereo


def _aligned(
    pipeline: dai.Pipeline, stereo: dai.node.StereoDepth, color: dai.Node.Output
) -> dai.Node.Output:
    """Return depth as the colour camera sees it; RVC4 devices have a node of its own for that."""
    device = pipeline.getDefaultDevice()
    if device.getPlatform() == dai.Platform.RVC4:
        align = pipeline.create(dai.node.ImageAlign)
        stereo.depth.link(align.input)
        color.link(align.inputAlignTo)
        return align.outputAligned
    color.link(stereo.inputAlignTo)
    return stereo.depth
