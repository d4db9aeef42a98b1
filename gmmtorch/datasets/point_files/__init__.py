"""Point cloud files (.npy, .las, .laz, .pcd, .ply): headers, and reading in chunks."""
