"""Models of single joints with effects, fitted side by side: joint by joint, along a reference of the robot."""
