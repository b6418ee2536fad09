"""Video: frames drawn by a software rasteriser, encoded with sound by ffmpeg."""
