"""Drawing a robot over a picture or into one, without OpenGL.

``meshes`` makes faces of a MuJoCo model, ``faces`` places them before a camera, and ``painter``
fills them into a picture with the compiled ``zbuffer``. ``drawn_robot`` draws a robot with its
shadow on a board, ``studio`` draws robots on an empty floor. ``prints`` draws exact ink on paper.
``overlay``, ``outlines`` and ``text`` draw lines and captions.
"""
