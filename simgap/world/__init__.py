"""The virtual model: hand, pads, blocks, operator and sensors."""
