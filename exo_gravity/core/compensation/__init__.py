"""From joint angles and tilt to the efforts that hold the arm."""
