// SPDX-License-Identifier: Apache-2.0
/// @file What is done to the sweep's hypotheses after matching; all give the same for any number of
/// threads.
#pragma once

#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <vector>

namespace omnister::sweep {

/// Median of the valid among 3x3, for valid pixels. @param in CV_32FC1, NaN where invalid
void medianFilter(const cv::Mat& in, cv::Mat* out, int threads);

/// Makes NaN of connected regions (4 neighbours, differing by at most `step`) smaller than `least`.
/// @return how many pixels went
std::size_t removeSpeckles(cv::Mat* h, float step, int least, int threads);

}  // namespace omnister::sweep
