// Exponential and logarithm of 8 numbers in float64.
// requires: elementary lanes/doubles

// in lanes: exp_of odd_series log_of
