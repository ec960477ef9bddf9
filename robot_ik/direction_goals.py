from robot_ik.goals import AimGoal, HalfSpaceGoal, LineGoal, PlaneGoal
