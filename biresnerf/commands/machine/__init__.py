"""Commands about this installation: doctor, bench, completion."""
