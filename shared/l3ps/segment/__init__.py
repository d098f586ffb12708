"""2D panoptic segmentation: model bundle, ONNX session, fusion of the heads."""
