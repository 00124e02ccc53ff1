"""What one would otherwise do: other ways to a map from the same walks, under one interface and one score."""
