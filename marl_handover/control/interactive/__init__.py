"""The cell that a person plays with: goal and block may be changed at any time, in mid-motion too."""
