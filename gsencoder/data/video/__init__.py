"""Videos: the frames of a film that structure from motion can use."""
