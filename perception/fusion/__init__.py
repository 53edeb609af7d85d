"""TSDF fusion, the baseline without a shape prior."""
