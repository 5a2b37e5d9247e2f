"""Photos and masks: found, decoded, turned upright, resized, compared. Reads no poses."""
