"""The surface that pictures show: its points under the pixels, and textures from what the pixels see."""
