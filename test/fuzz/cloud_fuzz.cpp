// SPDX-License-Identifier: Apache-2.0
#include "fuzz.h"
#include "omnister/stereo/cloud.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  takes([&] {
    const Cloud cloud = parseCloud(bytes, "input");
    require(cloud.bgr.size() == cloud.xyz.size() && cloud.sigma.size() == cloud.xyz.size(),
            "the images of a cloud have one size");
  });
}
