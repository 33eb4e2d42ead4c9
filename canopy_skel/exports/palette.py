"""The two colours of every picture: told apart by all kinds of colour vision, and in print.

Blue and vermillion of Okabe & Ito, "Color universal design" (2008), sRGB.
"""

OBSERVED_RGB = (0, 114, 178)
OCCLUDED_RGB = (213, 94, 0)
