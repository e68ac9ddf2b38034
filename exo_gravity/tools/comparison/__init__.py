"""The paper's comparison of all laws with independent references."""
