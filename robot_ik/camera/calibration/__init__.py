"""Parameters found from pictures: lens, where a camera is, the zeros of an arm's joints."""
