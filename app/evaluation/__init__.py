"""The paper's tables and ours: independent pieces of work, each a line on disk as it ends, then summaries."""
