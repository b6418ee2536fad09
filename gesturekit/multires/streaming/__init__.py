"""Motion while the person speaks: a stream of sound in, a stream of motion out."""
