// SPDX-License-Identifier: Apache-2.0
/// @file What is done to the sweep's hypotheses after matching; all give the same for any number of
/// threads.
#pragma once

#include <cstddef>
#include <opencv2/core/mat.hpp>

namespace omnister::sweep {

/// Makes NaN of connected regions (4 neighbours, differing by at most `step`) smaller than `least`
/// pixels. @param h CV_32FC1, NaN where invalid
/// @return how many pixels went
std::size_t removeSpeckles(cv::Mat* h, float step, int least, int threads);

}  // namespace omnister::sweep
