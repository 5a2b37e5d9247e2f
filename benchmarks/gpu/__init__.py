"""What a GPU would do, checked without one where that is possible, and measured where there is one."""
