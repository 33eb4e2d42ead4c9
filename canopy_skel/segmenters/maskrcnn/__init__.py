"""The paper's segmenter: Mask R-CNN, ResNet-50 with feature pyramid, at 1440 x 1080 (III-A).

Needs the extra `maskrcnn` (torchvision); `merging` alone does not.
"""
