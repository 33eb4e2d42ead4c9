"""A synthetic orchard: procedural trees, a renderer with labels, a stereo camera, ground truth."""
