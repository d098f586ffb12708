"""2D panoptic segmentation: model bundle, ONNX session, fusion of the heads."""

import os

# The Linux wheels of onnxruntime report their use to their maker unless this is set before they are imported.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"
