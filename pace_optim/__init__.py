"""PACE on MuJoCo: identify actuator parameters from recordings, and find the effect that is missing."""
