"""Front ends: each is a ``JointSink`` that shows joint angles and knows nothing of how they were found."""
