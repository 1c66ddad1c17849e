// SPDX-License-Identifier: Apache-2.0
// A client of `pcgraph serve`: writes the cloud of a file with its labels, as a PCD file, to the standard output.
// Build: g++ -std=c++17 client.cpp -lcurl -o client
// Usage: [PCGRAPH_TOKEN=...] ./client FILE [ADDRESS] > labelled.pcd
// If the service refuses, its answer is on the standard error output, and the exit status is 1.
#include <curl/curl.h>
#include <cstdio>
#include <cstdlib>
#include <string>

int main(int argc, char** argv) {
    const std::string path = argv[1], address = argc > 2 ? argv[2] : "http://127.0.0.1:8000";
    CURL* curl = curl_easy_init();
    curl_slist* headers = nullptr;
    if (const char* token = std::getenv("PCGRAPH_TOKEN"))
        headers = curl_slist_append(headers, (std::string("Authorization: Bearer ") + token).c_str());
    curl_easy_setopt(curl, CURLOPT_HTTPHEADER, headers);
    char problem[CURL_ERROR_SIZE] = "";
    curl_easy_setopt(curl, CURLOPT_ERRORBUFFER, problem);
    curl_mime* form = curl_mime_init(curl);
    curl_mimepart* part = curl_mime_addpart(form);
    curl_mime_name(part, "cloud");
    curl_mime_filedata(part, path.c_str());
    curl_easy_setopt(curl, CURLOPT_MIMEPOST, form);
    curl_easy_setopt(curl, CURLOPT_URL, (address + "/segmentations?wait=60").c_str());
    curl_easy_setopt(curl, CURLOPT_WRITEDATA, stderr);
    curl_header* location = nullptr;
    CURLcode failed = curl_easy_perform(curl);
    std::fprintf(stderr, "%s\n", problem);
    if (failed || curl_easy_header(curl, "Location", 0, CURLH_HEADER, -1, &location)) return 1;
    const std::string labels = address + location->value + "/labels?format=pcd";
    curl_easy_setopt(curl, CURLOPT_HTTPGET, 1L);
    curl_easy_setopt(curl, CURLOPT_URL, labels.c_str());
    curl_easy_setopt(curl, CURLOPT_WRITEDATA, stdout);
    curl_easy_setopt(curl, CURLOPT_FAILONERROR, 1L);
    failed = curl_easy_perform(curl);
    if (failed) std::fprintf(stderr, "%s\n", problem);
    curl_mime_free(form);
    curl_slist_free_all(headers);
    curl_easy_cleanup(curl);
    return failed ? 1 : 0;
}
