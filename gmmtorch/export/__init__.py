"""Files for other programs: map_server images, OctoMap trees, point clouds, mixtures."""
