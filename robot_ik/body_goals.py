from robot_ik.goals import *
from robot_ik.goals import GOALS
