"""From the user's input to files on disk: masks and photographs, looks at them, and batches in several processes."""
