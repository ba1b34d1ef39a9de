"""Laws: what makes an effort of a set-point and position samples."""
