"""Where a result leaves: files, pictures, reports."""
