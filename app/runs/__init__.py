"""What a run leaves on disk: folder, report and recording, and how they are read back."""
