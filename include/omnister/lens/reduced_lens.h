// SPDX-License-Identifier: Apache-2.0
/// @file The lens of an image that was made smaller.
#pragma once

#include "omnister/lens/lens_model.h"

namespace omnister {

/// The same lens for images reduced `factor` times by means over squares of pixels: pixel u of the
/// reduced image covers the pixels [factor u, factor (u + 1)), so that its centre is (u + 0.5)
/// factor - 0.5 of the full image. parameters(), and derivatives by them, stay those of the full
/// image.
/// @param factor 1 to 64; 1 gives the lens itself
/// @throws Error without a lens or for another factor
LensPtr reducedLens(const LensPtr& lens, int factor);

}  // namespace omnister
