// SPDX-License-Identifier: Apache-2.0
/// @file A range image as another camera would have it.
#pragma once

#include <opencv2/core/mat.hpp>

#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"

namespace omnister {

/// Takes the points of a range image to the pixels of a moved camera, the nearest winning: what a
/// robot that moved knows before it looks. Holes of one pixel, as they come where the new camera is
/// nearer, are closed.
/// @param range CV_32FC1 along the rays of `lens` [m], NaN where unknown
/// @param T_new_old coordinates of the old camera into the new one [m]
/// @return CV_32FC1 of `new_size`, along the rays of `new_lens` [m]; NaN where unknown
cv::Mat warpRange(const cv::Mat& range, const LensPtr& lens, const Pose& T_new_old,
                  const LensPtr& new_lens, cv::Size new_size, int threads = 0);

}  // namespace omnister
