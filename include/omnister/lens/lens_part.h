// SPDX-License-Identifier: Apache-2.0
/// @file The lens of a part of the sensor: a region of interest, binned or not.
#pragma once

#include <opencv2/core/types.hpp>

#include "omnister/lens/lens_file.h"

namespace omnister {

/// The same lens for images that show a part of the sensor. Pixel u of such an image is the mean of
/// the sensor's pixels from `region.x + binning.width u` on, so that the centre of its distortion
/// and all lengths in pixels change, and no ray does. Exact for every model; a binning that differs
/// across and down becomes an affinity. RMS figures are in the new pixels.
/// @param region in the sensor's own (unbinned) pixels, within the lens' image; its size is a
/// multiple of the binning but for a rest that is not read out
/// @param binning pixels of the sensor to one of the image, 1 or more
/// @throws InputError for a region or binning that does not fit
LensFile partOfLens(const LensFile& whole, const cv::Rect& region, const cv::Size& binning);

}  // namespace omnister
