"""Mask R-CNN with ResNet-50 and a feature pyramid, one class: branch."""

import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from torch import nn

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.weight_files import read_state, require_fit

if TYPE_CHECKING:
    from torchvision.models.detection import MaskRCNN

Norm = Literal["group", "frozen_batch"]
SIZE_PX = (1440, 1080)
"""Width and height that pictures are scaled to fit (the paper's)."""
MOST_BYTES = 512 << 20
_GROUPS = 32
_CLASSES = 2
_HEADS = ("roi_heads.box_predictor.", "roi_heads.mask_predictor.mask_fcn_logits.")
_DIGEST_IN_NAME = re.compile(r"-([0-9a-f]{8,})$")


def build(norm: Norm = "group", size_px: tuple[int, int] = SIZE_PX) -> "MaskRCNN":
    """Return a network with random weights.

    norm: GroupNorm, which batches of one or two pictures can be trained with from scratch
    (He et al., arXiv 1811.08883), or BatchNorm frozen at what a checkpoint says. size_px: width
    and height that pictures are scaled to fit.

    Raises:
        UsageError: torchvision is not installed.
    """
    try:
        from torchvision.models.detection import MaskRCNN
        from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
        from torchvision.ops import FrozenBatchNorm2d
    except ImportError as error:
        raise UsageError(
            "the maskrcnn segmenter needs torchvision: install the extra `maskrcnn` in an"
            " environment of its own (`make maskrcnn` does)"
        ) from error
    layer = partial(nn.GroupNorm, _GROUPS) if norm == "group" else FrozenBatchNorm2d
    backbone = resnet_fpn_backbone(
        backbone_name="resnet50", weights=None, norm_layer=layer, trainable_layers=5
    )
    return MaskRCNN(
        backbone,
        num_classes=_CLASSES,
        min_size=min(size_px),
        max_size=max(size_px),
        box_score_thresh=0.05,
    )


def pretrained(path: Path, size_px: tuple[int, int] = SIZE_PX) -> "MaskRCNN":
    """Return a network that starts from a checkpoint of torchvision's `maskrcnn_resnet50_fpn`.

    The last layers of its heads, which know other classes, are left random. Where the file's name
    ends in a digest, as torchvision's do (`…_coco-bf2d0c1e.pth`), it is checked.

    Raises:
        UsageError: the file is damaged, of another network, or torchvision is not installed.
    """
    network = build("frozen_batch", size_px)
    digest = _DIGEST_IN_NAME.search(path.stem)
    given = read_state(path, digest.group(1) if digest else None, MOST_BYTES)
    state = network.state_dict()
    kept = {
        name: value
        for name, value in given.items()
        if not name.startswith(_HEADS) and not name.endswith("num_batches_tracked")
    }
    body = {name: value for name, value in state.items() if not name.startswith(_HEADS)}
    require_fit(path, body, kept)
    network.load_state_dict(state | kept)
    return network
