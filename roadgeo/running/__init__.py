"""From what a user gives to files on disk: masks and photographs, looks at them, and batches in several processes."""
