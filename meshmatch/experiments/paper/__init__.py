"""The paper's tables and figures, and the other methods that they compare with."""
