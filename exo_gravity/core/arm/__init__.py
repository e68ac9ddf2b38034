"""The arm as a model: links, gravity, the wearer, the trunk's tilt, the torque budget."""
