"""Event windows and ground truth: sources (files), representation (events to tensors), augmentation, order, batches."""
