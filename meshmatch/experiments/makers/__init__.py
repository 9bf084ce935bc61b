"""What makes templates, rigs, and generated shapes with known correspondence."""
