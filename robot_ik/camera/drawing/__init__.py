"""Drawing a robot over a picture or into one, without OpenGL but for ``gl``.

``meshes`` makes faces of a MuJoCo model, ``painter`` puts them into a picture by the compiled
``rasteriser``, ``raycast`` asks MuJoCo what a pixel sees, ``prints`` has ink on paper, flat or before a
camera; ``renderers`` lists the back ends, ``overlay`` draws outlines and captions.
"""
