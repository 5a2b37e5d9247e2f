"""Published methods to compare with, loaded only by runs that use one."""
