"""Pictures that are computed, with exact truth: to try things without a camera, and to measure with.

``synthetic`` is a camera in numbers, ``carried`` one on the arm's hand, ``moving_set`` the sources
``synthetic:…``; ``standard_set``, ``pattern_set`` and ``handeye_set`` are the pictures that accuracy is
measured on.  The rest makes a photograph: ``photograph``, its ``stage``, ``lights``, ``texture``,
``view``, ``robot_layer`` and ``printed`` markers.
"""
