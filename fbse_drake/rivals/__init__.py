"""Every method of estimating the friction against each other, on the same walk and sensors."""
